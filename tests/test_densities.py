import numpy as np
import pytest
from scipy import stats

from v2hdm.densities import log_beta_density, log_normal_density, log_student_density, normal_density

VALUES = np.linspace(-60.0, 60.0, 241)
SIGMAS = np.array([[0.02], [1.0], [7.5]])


def close(values):
    return pytest.approx(values, rel=1e-13, abs=1e-300)


def test_normal_densities_are_those_of_scipy():
    assert normal_density(VALUES, 1.5, SIGMAS) == close(stats.norm.pdf(VALUES, 1.5, SIGMAS))
    assert log_normal_density(VALUES, 1.5, SIGMAS) == close(stats.norm.logpdf(VALUES, 1.5, SIGMAS))


@pytest.mark.parametrize("freedom", [1.0, 4.0, 30.0])
def test_the_density_of_students_t_is_that_of_scipy(freedom):
    expected = stats.t.logpdf(VALUES, freedom, 1.5, SIGMAS)
    assert log_student_density(VALUES, freedom, 1.5, SIGMAS) == close(expected)


@pytest.mark.parametrize("parameters", [(2.0, 300.0), (1.0, 6.0), (0.5, 0.5)])
def test_the_beta_density_is_that_of_scipy(parameters):
    shares = np.linspace(0.001, 0.999, 99)
    assert log_beta_density(shares, *parameters) == close(stats.beta.logpdf(shares, *parameters))
