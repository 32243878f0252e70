"""A scripted expert of ManiSkill's PickCube-v1: above the cube, down, grasp, to the goal."""

from __future__ import annotations

import torch


def make(env):
    """The expert of an environment with control_mode=pd_ee_delta_pos: an action of 1 moves the hand by 0.1 m."""

    def act(observation):
        seen = observation["extra"]
        hand, goal = seen["tcp_pose"][0, :3], seen["goal_pos"][0]
        cube = env.unwrapped.cube.pose.p[0]  # the truth, which an expert may use, whatever the learner sees
        away = cube - hand
        grip = torch.tensor([1.0])  # open
        if bool(seen["is_grasped"][0]):
            way, grip = goal - hand, -grip
        elif away[:2].norm() > 0.015:
            way = away + torch.tensor([0.0, 0.0, 0.06])
        elif away[2].abs() > 0.01:
            way = away
        else:
            way, grip = torch.zeros(3), -grip
        return torch.cat([(way / 0.1).clamp(-1, 1), grip])

    return act
