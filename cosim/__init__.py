"""Co-simulation: time, ports, systems, master, records, campaigns, FMUs; knows no navigation."""
