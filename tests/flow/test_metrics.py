from __future__ import annotations

import math

import pytest
import torch

from fb3d_rl.flow.metrics import flow_metrics, hypothesis_metrics, mean_metrics


def test_hand_computed_cloud() -> None:
    target = torch.tensor([[[1.0, 0, 0], [0, 2, 0], [0, 0, 0], [3, 0, 0]]])
    predicted = torch.tensor([[[0.0, 1, 0], [0, 0, 0], [5, 5, 5], [9, 9, 9]]])
    valid = torch.tensor([[True, True, True, False]])
    metrics = flow_metrics(predicted, target, valid)
    # Two moving points: one turned by 90 degrees, one predicted to stand still.
    assert metrics["rmse"].item() == pytest.approx((math.sqrt(2) + 2) / 2)
    assert metrics["cosine"].item() == 0.0
    assert metrics["magnitude_error"].item() == pytest.approx((0 + 2) / 2)


def test_cosine_ignores_length_and_sees_sign() -> None:
    target = torch.tensor([[[1.0, 2, 2]], [[1.0, 2, 2]], [[1e-3, 0, 0]]])
    predicted = torch.tensor([[[0.1, 0.2, 0.2]], [[-2.0, -4, -4]], [[1.0, 1, 0]]])
    cosine = flow_metrics(predicted, target, torch.ones(3, 1, dtype=torch.bool))["cosine"]
    torch.testing.assert_close(cosine, torch.tensor([1.0, -1.0, math.sqrt(0.5)]))


def test_cloud_without_motion_is_nan_and_left_out_of_the_mean() -> None:
    target = torch.zeros(2, 5, 3)
    target[1, 0, 0] = 1.0
    predicted = torch.zeros(2, 5, 3)
    predicted[1, 0, 0] = 0.5
    metrics = flow_metrics(predicted, target, torch.ones(2, 5, dtype=torch.bool))
    assert all(torch.isnan(values[0]) for values in metrics.values())
    assert mean_metrics(metrics) == pytest.approx({"rmse": 0.5, "cosine": 1.0, "magnitude_error": 0.5})


def test_of_several_proposals_the_most_probable_is_the_prediction_and_the_nearest_the_best() -> None:
    target = torch.tensor([[1.0, 0, 0], [0, 0, 0]]).expand(3, 2, 3).clone()
    target[2] = 0.0  # nothing moves
    other_sense, across, right = (torch.tensor([way, [9.0, 9, 9]]) for way in ([-1.0, 0, 0], [0.0, 1, 0], [0.9, 0, 0]))
    flows = torch.stack([other_sense, across, right]).expand(3, 3, 2, 3)
    probabilities = torch.tensor([[0.7, 0.2, 0.1], [0.1, 0.2, 0.7], [1.0, 0.0, 0.0]])
    predicted = torch.stack([other_sense, right, right])
    found = hypothesis_metrics(predicted, flows, probabilities, target, torch.ones(3, 2, dtype=torch.bool))
    assert found["axis_cosine"][:2].tolist() == [1.0, 1.0], "the sense does not count"
    assert found["best_cosine"][:2].tolist() == pytest.approx([1.0, 1.0])
    assert found["probability"][:2].tolist() == pytest.approx([0.7, 0.7])
    assert found["hit"][:2].tolist() == [0.0, 1.0]
    assert all(torch.isnan(values[2]) for values in found.values())
