"""Read logs, by one module for each format; `table.read_table` chooses among the modules."""
