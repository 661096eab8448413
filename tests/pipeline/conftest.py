"""The stores that these tests work on."""

from tests.stores import memory as memory
