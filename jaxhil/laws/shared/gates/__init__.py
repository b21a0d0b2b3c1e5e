"""Gates: factors that change smoothly between 0 and 1 after a signal crosses a threshold."""
