"""Give `read_table` its former name, `identify.csv_io.read_table`."""

from rigidjax.cli.logs.table import read_table as read_table
