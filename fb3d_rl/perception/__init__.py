"""From depth points to the cloud that policies see, and from a flow to the point to touch."""
