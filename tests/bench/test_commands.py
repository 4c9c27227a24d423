"""The list of benchmarks."""

import pytest

from benchmarks.__main__ import BENCHMARKS, main


def test_help_names_every_benchmark(capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit) as end:
        main(["--help"])
    assert end.value.code == 0
    printed = capsys.readouterr().out
    assert [name for name in BENCHMARKS if name not in printed] == []
