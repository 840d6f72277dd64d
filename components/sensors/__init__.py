"""What measures it: inertial and attitude sensors, radar, synthetic fixes."""
