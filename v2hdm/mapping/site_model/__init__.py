"""One posterior per place of the map: what lies there, where its corners are, and how sure either is."""
