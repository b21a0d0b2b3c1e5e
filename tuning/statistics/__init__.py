"""Statistics of errors and failures: intervals, quantiles, bootstrap, Sobol indices, subset simulation."""
