"""Parts of this project inside other libraries. Nothing else in the package imports them."""
