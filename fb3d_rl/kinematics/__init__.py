"""The kinematic tree: poses of links, what opens and which way, screws of joints."""
