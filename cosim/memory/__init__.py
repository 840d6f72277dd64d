"""What ports stand on during a simulation: slots, messages, and the links between them."""
