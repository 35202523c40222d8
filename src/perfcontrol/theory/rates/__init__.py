"""What a certificate promises: step sizes, error bounds, which sensitivities and orders are admissible."""
