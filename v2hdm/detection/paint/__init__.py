"""From what the network says of each pixel to pieces of paint, of which class, about where."""
