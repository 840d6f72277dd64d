"""Monte Carlo campaigns: members flown in batches, statistics, and a verdict."""
