"""Co-simulation: exact time, ports, systems, master, records, checkpoints. Knows no navigation."""
