"""How numbers, tables, figures and pages look to a person; knows data, not systems."""
