"""What things are: protocols and small frozen dataclasses that import nothing heavy."""
