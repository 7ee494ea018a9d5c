"""Both implementations offer the same operations, and `native` is the one that training uses."""

import inspect

import vdgs.kernels.cpu as native
import vdgs.kernels.torch_ref as reference
from vdgs.kernels.operations import OPERATION_NAMES


def test_both_implementations_offer_the_same_operations():
    assert all(callable(getattr(room, name)) for room in (native, reference) for name in OPERATION_NAMES)


def test_the_arguments_have_the_same_names_in_the_same_order():
    for name in OPERATION_NAMES:
        ours, twins = (inspect.signature(getattr(room, name)).parameters for room in (native, reference))
        shared = list(ours.values())[: len(twins)]  # a native operation may also take the module to run on
        assert [p.name for p in shared] == list(twins), name
        assert [p.default for p in shared] == [p.default for p in twins.values()], name
