"""A policy server for robots: messages (``protocol``), one client's episode (``episode``), the socket (``server``)."""
