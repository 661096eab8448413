"""Many drives: side by side in processes of this machine, and shared out among machines."""
