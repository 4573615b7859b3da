"""Scripts behind the figures and numbers that this package states; ``python -m validation`` runs them all and writes one report."""
