"""Contact laws, one file each; `jaxhil.contact` has them by name."""
