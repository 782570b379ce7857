"""The cloud of a fleet, for notebooks and tools. A lambda cannot use it: it runs without a network.

``Cloud`` lists vehicles, deployments, events and clips, and fetches clips. ``gleaner_fleet.export``
reads the folder that ``gleaner clips export --to DIR`` writes.
"""

from ._client import Clip, ClipState, Cloud, CloudError

__all__ = ["Clip", "ClipState", "Cloud", "CloudError"]
