"""What is reckoned of many flights: facts, folds, chances; pure."""
