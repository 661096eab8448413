"""The benchmarks of ports measure the ports that are shipped."""

import pytest

from tests.benchmarks.adjust_ports import port_config


@pytest.mark.parametrize("run", ["port1", "port2"])
def test_a_benchmark_takes_the_port_of_a_shipped_run(run):
    assert port_config(run).name == run
