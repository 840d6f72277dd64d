"""Exchange with other tools: FMUs, and packages of them."""
