"""How synthetic people are shaded and lit for training data."""
