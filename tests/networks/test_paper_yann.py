"""The paper's own network, layer by layer: its parameter counts, its values and its defects."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
import torch as th

from sample_laws import PROBLEMS, box_points, facet_points, law_of, smallest_slack
from sb3_yann.control import PiecewiseAffine
from sb3_yann.networks.paper_yann import PaperYann

EVERY_LAW = pytest.mark.parametrize("name", PROBLEMS)


@pytest.fixture
def float64() -> Iterator[None]:
    before = th.get_default_dtype()
    th.set_default_dtype(th.float64)
    yield
    th.set_default_dtype(before)


def well_inside(law: PiecewiseAffine, count: int, margin: float) -> th.Tensor:
    """Points at least ``margin`` away from every facet of their region."""
    theta = box_points(law, count)
    return theta[th.as_tensor(smallest_slack(law, theta).max(axis=1) > margin)]


@pytest.mark.parametrize(
    ("name", "width", "total", "trainable"),
    # Braniff & Tian, Sections 5.1 and 5.2: the parameter counts of the two YANN-actors.
    [("pendulum", 16, 15_188, 12_880), ("reactor", 8, 5_320, 3_416)],
)
def test_parameter_counts_are_those_of_the_paper(
    name: str, width: int, total: int, trainable: int
) -> None:
    parameters = list(PaperYann(law_of(name), width).parameters())
    assert sum(p.numel() for p in parameters) == total
    assert sum(p.numel() for p in parameters if p.requires_grad) == trainable


@EVERY_LAW
@pytest.mark.parametrize("width", [1, 7, 16])
@pytest.mark.usefixtures("float64")
def test_network_is_the_law_away_from_facets(name: str, width: int) -> None:
    law = law_of(name)
    theta = well_inside(law, 5000, margin=1e-6).double()
    assert len(theta) > 1000
    u = PaperYann(law, width)(theta).detach().numpy()
    np.testing.assert_allclose(u, law(theta.numpy()), rtol=0, atol=1e-9)


@pytest.mark.usefixtures("float64")
def test_network_doubles_or_drops_the_law_on_facets() -> None:
    # The known defect of step indicators: on a shared facet two regions are active, or none.
    law = law_of("pendulum")
    theta = facet_points(law, 20_000).double()
    # To the facet itself: from the float32 point along its normal, in float64.
    slack = law.b - theta.numpy() @ law.A.T
    nearest = np.argmin(np.abs(slack), axis=1)
    normal = law.A[nearest] / np.sum(law.A[nearest] ** 2, axis=1, keepdims=True)
    on_facet = theta.numpy() + slack[np.arange(len(theta)), nearest, None] * normal
    u = law(on_facet)[:, 0]
    got = PaperYann(law, 8)(th.as_tensor(on_facet)).detach().numpy()[:, 0]
    clear = np.abs(u) > 0.1
    ratio = got[clear] / u[clear]
    doubled, dropped = np.abs(ratio - 2) < 1e-6, np.abs(ratio) < 1e-6
    assert np.all(doubled | dropped | (np.abs(ratio - 1) < 1e-6))
    assert np.mean(doubled | dropped) > 0.1


@EVERY_LAW
def test_output_is_zero_where_no_region_holds_theta(name: str) -> None:
    law = law_of(name)
    theta = th.cat([box_points(law, 5000), box_points(law, 5000, stretch=1.02)])
    theta = theta[th.as_tensor(smallest_slack(law, theta).max(axis=1) < -1e-4)]
    assert len(theta) > 20
    assert not th.any(PaperYann(law, 8)(theta))


@EVERY_LAW
def test_inactive_regions_stay_suppressed_whatever_is_learnt(name: str) -> None:
    law = law_of(name)
    network = PaperYann(law, 16)
    for weight in (network.first_weight, network.first_bias, network.second_weight):
        th.nn.init.normal_(weight, std=100.0)  # every node at its bound of 1
    theta = box_points(law, 5000, stretch=1.02)
    theta = theta[th.as_tensor(smallest_slack(law, theta).max(axis=1) < -1e-4)]
    assert len(theta) > 20
    assert not th.any(network(theta))
