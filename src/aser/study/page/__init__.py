"""The page of results: a static site made from the committed files alone."""
