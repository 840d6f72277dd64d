"""How symbolic components are stepped: compiled, vectorized, or by CasADi itself."""
