"""Plots of results; `jaxhil.simulation.contact_plot` has the plot of a run, the colours and the layout."""
