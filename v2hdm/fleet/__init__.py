"""Many drives on Ray: detection by workers that keep the model loaded, one mapping task a drive."""
