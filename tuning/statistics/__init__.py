"""Statistics of errors and failures: intervals, quantiles, resampling, Sobol indices, rare events."""
