"""What is done with a trained policy, or to find out what works here. Kept empty: `originals` runs where only NumPy is."""
