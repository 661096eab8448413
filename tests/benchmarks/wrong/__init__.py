"""Wrong inputs of the kinds that users make, each as a change of a good drive folder."""
