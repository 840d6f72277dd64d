"""What is known of the ground beforehand."""
