"""Both implementations offer the same operations, and `native` is the one that training uses."""

import inspect

import vdgs.kernels.native as native
import vdgs.kernels.reference as reference


def test_both_implementations_offer_the_same_operations():
    assert sorted(native.__all__) == sorted(reference.__all__)


def test_the_arguments_have_the_same_names_in_the_same_order():
    for name in native.__all__:
        ours, twins = (inspect.signature(getattr(room, name)).parameters for room in (native, reference))
        shared = list(ours.values())[: len(twins)]  # a native operation may also take the module to run on
        assert [p.name for p in shared] == list(twins), name
        assert [p.default for p in shared] == [p.default for p in twins.values()], name
