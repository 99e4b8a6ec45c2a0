"""Why a frame cannot be used; the odometry is as it was before."""


class RejectedFrame(ValueError):
    """A frame that cannot be used; the odometry is as it was before."""


class DuplicateFrame(RejectedFrame):
    """A frame with the stamp of the last one."""


class LateFrame(RejectedFrame):
    """A frame that is a little older than the last one."""


class UnusableImage(RejectedFrame):
    """An image or scan of the wrong size or type, one whose values make no sense, or an unknown action or velocity."""
