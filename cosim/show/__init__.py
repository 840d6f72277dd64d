"""How numbers, tables and figures look to a person; knows data, not systems."""
