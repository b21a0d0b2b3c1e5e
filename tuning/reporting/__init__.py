"""What people look at when the work is done: stability maps, and the page of a review board."""
