"""Pictures: a renderer for the CPU, arrows, captions, and the encoding of videos. It knows no policy and no trial."""
