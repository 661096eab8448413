"""From solved corners to the markings of the map: completed, compared with their class, judged."""
