"""Objects from files of other makers: found, read, brought to the project's units and axes, and written as folders."""
