"""Import `read_table` at its old place, for programs that use `identify.csv_io.read_table`."""

from rigidjax.cli.logs.table import read_table as read_table
