"""Run the command line: `command` runs it, `spec` makes a model of its options, `logs` reads
logs.
"""
