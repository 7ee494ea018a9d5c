"""What one scale for both axes of the clustering changes (`partition.cluster_scale`), on a made-up long place.

    python -m experiments.reports.analyses.cluster_scale

20 000 anchors lie evenly over 400 by 100 units; V falls from 50 in the middle as a Gaussian of 60 units. Clusters of
eq. 5 alone: no components, boundaries or cameras. Prints Markdown.
"""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np
from jaxtyping import Float, Int64
from sklearn.metrics import adjusted_rand_score

from vdgs.config.method import PartitionConfig
from vdgs.partition.clustering import cluster_anchors, clustering_features

Scale = Literal["axis", "common"]
EXTENT, ANCHORS, BLOCKS, MOST_SEEN, WIDTH = (400.0, 100.0), 20_000, 8, 50, 60.0


def long_place(seed: int) -> tuple[Float[np.ndarray, "n 2"], Int64[np.ndarray, " n"]]:
    """Places and V of the anchors."""
    points = np.random.default_rng(seed).uniform(0, EXTENT, (ANCHORS, 2))
    distance = np.linalg.norm(points - np.array(EXTENT) / 2, axis=1)
    return points, (MOST_SEEN * np.exp(-((distance / WIDTH) ** 2))).astype(np.int64)


def deviation(visibility: Int64[np.ndarray, " n"], labels: Int64[np.ndarray, " n"]) -> float:
    """Standard deviation of V from the means of the clusters."""
    means = np.array([visibility[labels == label].mean() for label in range(BLOCKS)])
    return float(np.sqrt(((visibility - means[labels]) ** 2).mean()))


def main(seed: int = 0) -> None:
    points, visibility = long_place(seed)
    labels = {
        scale: cluster_anchors(
            clustering_features(points, visibility, PartitionConfig(cluster_clip=0.0, cluster_scale=scale)),
            BLOCKS, seed, balanced=False,
        )
        for scale in get_args(Scale)
    }  # fmt: skip
    print("| cluster_scale | standard deviation of V in clusters, in all | adjusted Rand index to `axis` |\n|---|---|---|")
    for scale, each in labels.items():
        like = adjusted_rand_score(labels["axis"], each)
        print(f"| {scale} | {deviation(visibility, each):.2f}, {visibility.std():.2f} | {like:.2f} |")


if __name__ == "__main__":
    main()
