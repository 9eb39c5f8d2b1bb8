"""Import `read_table` under its former name, for programs that use `identify.csv_io.read_table`."""

from rigidjax.cli.logs.table import read_table as read_table
