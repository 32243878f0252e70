"""From a depth camera's points to the cloud that policies see."""
