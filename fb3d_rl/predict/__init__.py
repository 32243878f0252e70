"""From a cloud of the user's own to a plan: flow, contact point, pull and the pose of the gripper."""
