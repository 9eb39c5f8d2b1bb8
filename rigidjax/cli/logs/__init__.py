"""Readers of logs, one format in each module; `table.read_table` chooses among them."""
