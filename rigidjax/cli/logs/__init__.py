"""Readers of logs, one module for each format; `table.read_table` chooses among them."""
