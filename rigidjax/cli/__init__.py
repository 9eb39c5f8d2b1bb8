"""Run the command line: `command` runs a command, `spec` makes a model from the options, `logs`
reads logs.
"""
