"""Copies on a card: kept as long as their originals are there, and as there is room for them."""

from __future__ import annotations

import torch

from support.fake_device import CARD, pretended_card
from vdgs.kernels import transfer
from vdgs.kernels.transfer import COPIES_SHARE, DeviceCopies

WHOLE = (slice(0, 4), slice(0, 6))


def picture(value: int) -> torch.Tensor:
    return torch.full((4, 6, 3), value, dtype=torch.uint8)


def test_a_picture_comes_to_the_card_once():
    with pretended_card():
        copies, first = DeviceCopies(), picture(7)
        sent = copies.part(first, WHOLE, CARD)
        assert sent.device == CARD
        part = copies.part(first, (slice(1, 3), slice(2, 5)), CARD)
        assert part.shape == (2, 3, 3)
        assert part.untyped_storage().data_ptr() == sent.untyped_storage().data_ptr()
        other = copies.part(picture(8), WHOLE, CARD)
        assert (int(sent[0, 0, 0]), int(other[0, 0, 0])) == (7, 8)


def test_each_card_has_its_own_copies_and_its_own_room(monkeypatch):
    sent = []
    monkeypatch.setattr(transfer, "upload", lambda tensor, device: sent.append(device) or tensor.clone())
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda device: (int(100 / COPIES_SHARE), 10**9))
    copies, original, cards = DeviceCopies(), picture(7), [torch.device("cuda", index) for index in (0, 1)]
    for card in (*cards, *cards):  # of 72 bytes: one on each has room
        copies.part(original, WHOLE, card)
    assert sent == cards


def test_what_there_is_no_room_for_comes_each_time_until_there_is(monkeypatch):
    with pretended_card():
        monkeypatch.setattr(torch.cuda, "mem_get_info", lambda device: (int(100 / COPIES_SHARE), 10**9))
        copies, first, second = DeviceCopies(), picture(7), picture(8)  # of 72 bytes each
        kept = copies.part(first, WHOLE, CARD)
        sent = [copies.part(second, WHOLE, CARD) for _ in range(2)]
        assert [int(each[0, 0, 0]) for each in sent] == [8, 8]
        assert sent[0].untyped_storage().data_ptr() != sent[1].untyped_storage().data_ptr()
        assert copies.part(first, WHOLE, CARD).data_ptr() == kept.data_ptr()
        del first, kept  # as a cache of photographs drops them
        again = [copies.part(second, WHOLE, CARD) for _ in range(2)]
        assert again[0].data_ptr() == again[1].data_ptr()


def test_on_the_processor_nothing_is_copied():
    original = picture(7)
    assert DeviceCopies().part(original, WHOLE, torch.device("cpu")).data_ptr() == original.data_ptr()
