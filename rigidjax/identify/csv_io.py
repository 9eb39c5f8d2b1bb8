"""The former place of `read_table`, kept for programs that import `identify.csv_io.read_table`."""

from rigidjax.cli.logs.table import read_table as read_table
