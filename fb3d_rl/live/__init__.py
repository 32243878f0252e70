"""An object in a person's hands: what is looked at and done (``session``), and the page in the browser (``page``)."""
