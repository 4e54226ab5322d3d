"""How good predicted covariances are: methods side by side, chains, one result."""
