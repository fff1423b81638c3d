"""Any set of runs on one page, ranked where rules and data are the same and nowhere else."""
