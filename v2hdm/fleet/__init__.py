"""Many drives on Ray: detection by actors that keep the model loaded, one mapping task per drive."""
