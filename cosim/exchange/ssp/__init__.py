"""Systems written as SSP packages, and read from them."""
