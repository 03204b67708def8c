"""What a belief knows of items, against SciPy's ranks and scikit-learn's principal components."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import settings as profile
from hypothesis import strategies as st
from scipy.stats import rankdata
from sklearn.decomposition import PCA

import proposer_rl as prl
from proposer_rl.curricula.belief import WIDEST
from proposer_rl.teaching.tables import few_columns, ranks


@profile(max_examples=50)
@given(st.lists(st.floats(-1e12, 1e12), min_size=1, max_size=9))
def test_ranks_are_those_of_scipy(column: list[float]) -> None:
    found = ranks(torch.tensor(column, dtype=torch.float64).unsqueeze(1))[:, 0]
    expected = (2 * rankdata(column) - 1) / len(column) - 1
    assert found.tolist() == pytest.approx(expected.tolist(), abs=1e-6)


@pytest.mark.parametrize("last", [None, 0.8, float("nan")])
def test_wide_features_leave_room_for_pass_rates(last: float | None) -> None:
    generator = torch.Generator().manual_seed(0)
    embedding = torch.randn(40, 60, generator=generator) * torch.linspace(0.1, 9, 60)
    rates = None if last is None else [0.2] * 39 + [last]
    items = prl.Items(40, features=embedding, pass_rates=rates)
    known = items.inputs(items.generate(torch.arange(40), []))
    assert known.shape == (40, WIDEST)  # a belief would project more, the rates among them
    columns = {None: 0, 0.8: 1}.get(last, 2)  # the second says where there is no rate
    torch.testing.assert_close(known[:, : WIDEST - columns], few_columns(embedding, columns))
    for column in known[:, WIDEST - columns :].mT[-1:]:
        assert column.tolist() == pytest.approx([-1 / 40] * 39 + [39 / 40])


def test_wide_features_are_ranks_of_their_principal_components() -> None:
    table = torch.randn(50, 30, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    table = table @ torch.randn(30, 30, generator=torch.Generator().manual_seed(2)).double()
    own = ((table - table.mean(0)) / table.std(0)).clamp(-3, 3).numpy()
    # They are not centred once more after outliers were cut off.
    expected = PCA(WIDEST).fit_transform(own - own.mean(0))
    found = few_columns(table)
    for place in range(4):  # those that are far apart in variance; signs are free
        twin = torch.from_numpy(rankdata(expected[:, place])).float()
        alike = torch.corrcoef(torch.stack([found[:, place], twin]))[0, 1].abs()
        assert float(alike) > 0.98
