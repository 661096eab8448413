"""A new drive against an earlier map: what stayed, what moved, what is gone, what is new."""
