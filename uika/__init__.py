"""UIKA on Dr.Jit."""
