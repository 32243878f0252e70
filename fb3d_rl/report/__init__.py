"""What people read: the pages of a run and of a comparison."""
