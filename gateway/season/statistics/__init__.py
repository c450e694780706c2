"""What is computed from many flights: facts of each, comparisons, cross-validation; pure."""
