"""Classes that a finished network learns alone, such as words and boxes, by two rows of its last layers."""
