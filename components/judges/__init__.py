"""Who looks on: evaluation of estimates, and albums of images."""
