"""Plots of results; the plot of a one-axis run and the layout are in `jaxhil.simulation.contact_plot`."""
