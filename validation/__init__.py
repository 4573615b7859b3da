"""Scripts behind the figures and numbers that this package states; each writes its results to validation/results."""
