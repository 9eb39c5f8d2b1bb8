"""The command line: `command` runs it, `spec` makes a problem of its options, `logs` reads."""
