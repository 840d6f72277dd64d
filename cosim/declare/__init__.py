"""What a component declares (ports, parameters, states), and the component itself."""
