"""The stores that these tests work on."""

from tests.stores import memory as memory
from tests.stores import s3 as s3
