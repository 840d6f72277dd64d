"""Linear covariance analysis: a campaign predicted from one run."""
