from __future__ import annotations

import pytest
import torch

from fb3d_rl.geometry import points as ops
from fb3d_rl.geometry import points_cpu


def make_clouds() -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(2)
    points = torch.rand(3, 50, 3, generator=generator)
    valid = torch.rand(3, 50, generator=generator) < 0.7
    valid[:, 0] = False
    return points, valid


def test_farthest_point_sample_follows_its_definition() -> None:
    points, valid = make_clouds()
    chosen = ops.farthest_point_sample(points, 8, valid)
    for cloud, inside, picks in zip(points, valid, chosen, strict=True):
        assert picks[0] == inside.nonzero()[0, 0]
        for count in range(1, 8):
            gap = torch.cdist(cloud, cloud[picks[:count]]).amin(1).masked_fill(~inside, -1)
            assert gap[picks[count]] == gap.max()


def test_farthest_point_sample_of_few_points_repeats_valid_ones() -> None:
    points, valid = make_clouds()
    valid[:] = False
    valid[:2, [4, 9]] = True
    chosen = ops.farthest_point_sample(points, 6, valid)
    assert set(chosen[:2].flatten().tolist()) == {4, 9}
    assert chosen[0, :2].tolist() == [4, 9]
    assert chosen[2].tolist() == [0] * 6


def test_what_was_sampled_first_is_what_sampling_again_would_choose() -> None:
    """PointNet++ relies on it: a coarser level is the beginning of the level before."""
    points, valid = make_clouds()
    points[1, 20:] = points[1, 1]
    points[2] = points[2].mul(4).round()  # a grid, where many distances are equal
    once = ops.gather(points, ops.farthest_point_sample(points, 40, valid))
    again = ops.gather(once, ops.farthest_point_sample(once, 15))
    assert torch.equal(again, once[:, :15])


def test_a_cpu_samples_and_groups_as_plain_pytorch_does_to_the_last_index() -> None:
    generator = torch.Generator().manual_seed(5)
    for number in range(40):
        batch, n = (1, 4)[number % 2], int(torch.randint(60, 900, (), generator=generator))
        points = torch.randn(batch, n, 3, generator=generator)
        if number % 4 > 1:
            points = points.mul(8).round() / 10  # many distances are equal but for rounding
        valid = torch.rand(batch, n, generator=generator) < (0.9, 0.02)[number % 3 == 0]
        valid[-1] &= number % 5 > 0
        chosen = points_cpu.farthest_point_sample(points, n // 3, valid)
        assert torch.equal(chosen, ops._farthest_plain(points, n // 3, valid))
        centres = ops.gather(points, chosen) + 3.0 * (number % 7 == 0)
        for answer, plain in zip(
            points_cpu.ball_query(points, centres, 0.6, 17, valid),
            ops._balls_plain(points, centres, 0.6, 17, valid),
            strict=True,
        ):
            assert torch.equal(answer, plain)


def test_ball_query_keeps_the_first_valid_points_by_index() -> None:
    points, valid = make_clouds()
    centres = points[:, ::7]
    index, mask = ops.ball_query(points, centres, 0.4, 5, valid)
    overfull = 0
    for b in range(3):
        for m in range(centres.shape[1]):
            near = [j for j in range(50) if valid[b, j] and (points[b, j] - centres[b, m]).square().sum() <= 0.4**2]
            overfull += len(near) > 5
            assert index[b, m][mask[b, m]].tolist() == near[:5]
            filler = near[0] if near else 0
            assert index[b, m][~mask[b, m]].tolist() == [filler] * int((~mask[b, m]).sum())
    assert overfull > 3


def test_knn_and_three_nn_never_touch_padding() -> None:
    points, valid = make_clouds()
    queries = torch.rand(3, 20, 3, generator=torch.Generator().manual_seed(0))
    squared, index = ops.knn(points, queries, 4, valid)
    distance = torch.cdist(queries, points).masked_fill(~valid[:, None], torch.inf)
    expected = distance.sort(dim=2)
    assert torch.equal(index, expected.indices[..., :4])
    torch.testing.assert_close(squared.sqrt(), expected.values[..., :4], atol=1e-5, rtol=0)

    index, weight = ops.three_nn(points, queries, valid)
    torch.testing.assert_close(weight.sum(2), torch.ones(3, 20))
    # The weights fall with the square of the distance.
    ratio = (distance.gather(2, index[..., 1:2]) / distance.gather(2, index[..., :1])) ** 2
    torch.testing.assert_close(weight[..., :1] / weight[..., 1:2], ratio, rtol=1e-3, atol=0)

    only_two = torch.zeros_like(valid)
    only_two[:, [3, 5]] = True
    index, weight = ops.three_nn(points, queries, only_two)
    assert weight[..., 2].abs().max() == 0
    assert set(index[..., :2].flatten().tolist()) == {3, 5}
    # On a point itself, interpolation gives that point's value.
    index, weight = ops.three_nn(points, points[:, 3:4], valid | only_two)
    assert index[0, 0, 0] == 3
    assert weight[0, 0, 0] == pytest.approx(1.0)
    assert ops.three_nn(points, queries, torch.zeros_like(valid))[1].abs().max() == 0


def test_gathers_agree_and_the_gradient_adds_up() -> None:
    points, _ = make_clouds()
    index = torch.tensor([[[4, 4], [0, 7]]]).expand(3, 2, 2)
    assert torch.equal(ops.gather(points, index)[2, 1, 1], points[2, 7])
    rows = points[0].clone().requires_grad_(True)
    ops.take_rows(rows, index[0]).sum().backward()
    assert rows.grad is not None
    assert rows.grad[:, 0].nonzero().flatten().tolist() == [0, 4, 7]
    assert rows.grad[4].tolist() == [2.0, 2.0, 2.0]


def test_curvature_and_normals_of_plane_sphere_and_corner() -> None:
    generator = torch.Generator().manual_seed(1)
    plane = torch.rand(1, 300, 3, generator=generator) * torch.tensor([1.0, 1.0, 0.0])
    sphere = torch.nn.functional.normalize(torch.randn(1, 300, 3, generator=generator), dim=2)
    above = torch.tensor([[0.5, 0.5, 9.0]])
    curvature, normals = ops.pca_curvature(plane, ops.knn(plane, plane, 12), viewpoint=above)
    assert curvature.abs().max() < 1e-6
    torch.testing.assert_close(normals, torch.tensor([0.0, 0, 1]).expand_as(normals), atol=1e-3, rtol=0)
    curvature, normals = ops.pca_curvature(sphere, ops.knn(sphere, sphere, 12), viewpoint=torch.zeros(1, 3))
    assert curvature.min() > 1e-4 and curvature.max() < 1 / 3
    assert (normals * -sphere).sum(2).mean() > 0.97
    # Padding neither counts as a neighbour nor gets a value.
    noisy = torch.cat([plane, torch.rand(1, 300, 3, generator=generator)], 1)
    valid = torch.arange(600)[None] < 300
    curvature, normals = ops.pca_curvature(noisy, ops.knn(noisy, noisy, 12, valid), valid)
    assert curvature.abs().max() < 1e-6
    assert normals[:, 300:].abs().max() == 0
    # Too few points for a plane still give numbers.
    two = plane[:, :2]
    assert torch.cat([x.flatten() for x in ops.pca_curvature(two, ops.knn(two, two, 12))]).isfinite().all()
