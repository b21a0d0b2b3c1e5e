"""Plots of results; the plot of a run, the colours and the layout are in `jaxhil.simulation.contact_plot`."""
