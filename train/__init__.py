"""`python -m train`: renders in, checkpoint out; see train/README.md."""
