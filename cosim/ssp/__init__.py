"""System Structure and Parameterization: systems exchanged as packages of FMUs."""
