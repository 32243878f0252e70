"""An interactive view of an object: its state and actions (``session``), and the page in the browser (``page``)."""
