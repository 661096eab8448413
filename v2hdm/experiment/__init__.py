"""The paper's experiment: both ports, every camera set, every method, over several seeds."""
