"""Pictures: a renderer for the CPU, arrows, and the encoding of videos; independent of policies and trials."""
