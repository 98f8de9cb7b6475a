"""Reference implementation, in float64, of the matching cost of planes with which `stereo_ops.patch_match` begins, of
`stereo_ops.support`, `stereo_ops.fit_surfaces` and `stereo_ops.compare_shading`."""

from __future__ import annotations

import numpy as np

from linprim_geo.geometry.camera import Camera

# Samples of the window per side, two pixels apart; standard deviation of the spatial weights in pixels; cost of what
# cannot be compared.
SIDE, NEAR_PIXELS, WORST = 6, 5.0, 2.0
# Standard deviations of the bilateral weights in grey values, from the narrowest; number of these by which a sample may
# differ; share of the window that must resemble the centre pixel; variance that the window needs, relative to that of
# the noise.
NEAR_GREYS, FAR_GREY, OWN_SHARE, INFORMED = (10.0, 25.0, 60.0), 2.5, 0.5, 4.0
# Offsets in pixels for the central difference of a mapping.
STEP = np.array([-1e-4, 1e-4])
# Reach of the cross of `support` in pixels, and the difference in grey values that ends it.
CROSS_REACH, CROSS_GREY = 10, 25
# `fit_surfaces` tries the planes in every CANDIDATE_STEP-th row and column of a cross, with SCALES tolerances, each
# half of the previous one. It fits to at least FEWEST_FITTED pixels, in FIT_ROUNDS rounds. A term is dropped if earlier
# terms leave less than TERM_LEFT of its sum of squares.
CANDIDATE_STEP, SCALES, FEWEST_FITTED, FIT_ROUNDS, TERM_LEFT = 5, 4, 12, 2, 1e-6

# For `compare_shading`: the range of gains, and the number of reweighting rounds.
GAINS, ROUNDS = (0.7, 1.4), 3


def match_cost(
    camera: Camera, grey: np.ndarray, other: Camera, other_grey: np.ndarray, plane: np.ndarray, noise: float
) -> np.ndarray:
    """Return (H, W) costs, 1 - normalised cross-correlation of windows along (H, W, 3) planes of inverse depth, 0 to 2.
    A plane maps a window by its derivative at the centre."""
    height, width = grey.shape
    offset = np.arange(1 - SIDE, SIDE, 2)
    down, right = (x.ravel() for x in np.meshgrid(offset, offset, indexing="ij"))
    cost = np.full(grey.shape, WORST)
    for row in range(height):
        for column in range(width):
            y, x = np.clip(row + down, 0, height - 1), np.clip(column + right, 0, width - 1)
            own = grey[y, x].astype(np.float64)
            near = np.exp(-0.5 * (down**2 + right**2) / NEAR_PIXELS**2)
            plain = grey[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2].var() < INFORMED * noise
            weight = _window(own, float(grey[row, column]), near, noise, plain)
            w, slope_x, slope_y = plane[row, column].astype(np.float64)
            middle = _pixels(camera, other, np.array([column]), np.array([row]), np.array([w]))[0]
            if not ((middle >= 0).all() and middle[0] <= other.width - 1.001 and middle[1] <= other.height - 1.001):
                continue
            along_row, along_column = (
                np.diff(_pixels(camera, other, column + STEP * x, row + STEP * y, w + slope * STEP), axis=0)
                / np.ptp(STEP)
                for x, y, slope in ((1, 0, slope_x), (0, 1, slope_y))
            )
            there = middle + right[:, None] * along_row + down[:, None] * along_column
            theirs = _bilinear(other_grey.astype(np.float64), there)
            a, b = own - weight @ own, theirs - weight @ theirs
            variances = (weight @ a**2 + noise) * (weight @ b**2 + noise)
            cost[row, column] = np.clip(1 - (weight * a) @ b / np.sqrt(variances), 0, WORST)
    return cost


def _window(own: np.ndarray, middle: float, near: np.ndarray, noise: float, plain: bool) -> np.ndarray:
    """Return the weights of a window's grey values, with sum 1. `plain`: no edge passes through its centre."""
    for spread in NEAR_GREYS:
        away = np.abs(own - middle) / spread
        weight = np.where(away > FAR_GREY, 0, np.exp(-0.5 * away**2)) * near
        total = weight.sum()
        if not total:
            continue
        weight /= total
        variance = weight @ (own - weight @ own) ** 2
        if (variance > INFORMED * noise and total > OWN_SHARE * near.sum()) or plain:
            break
    return weight


def _pixels(camera: Camera, other: Camera, column: np.ndarray, row: np.ndarray, inverse: np.ndarray) -> np.ndarray:
    """Return (N, 2) positions in another image, with 0 at the centre of its first pixel, of pixels at inverse
    depths."""
    rays = np.stack([(column + 0.5 - camera.cx) / camera.fx, (row + 0.5 - camera.cy) / camera.fy, np.ones(len(row))])
    pose = other.world_to_camera @ np.linalg.inv(camera.world_to_camera)
    p = pose[:3, :3] @ rays + pose[:3, 3:] * inverse
    if (p[2] <= 0).any():
        return np.full((len(row), 2), -1.0)
    return np.stack([other.fx * p[0] / p[2] + other.cx - 0.5, other.fy * p[1] / p[2] + other.cy - 0.5], axis=1)


def _bilinear(image: np.ndarray, places: np.ndarray) -> np.ndarray:
    u, v = (np.clip(places[:, k], 0, image.shape[1 - k] - 1.001) for k in (0, 1))
    x, y = u.astype(int), v.astype(int)
    a, b = u - x, v - y
    top, bottom = (image[y + k, x] * (1 - a) + image[y + k, x + 1] * a for k in (0, 1))
    return top * (1 - b) + bottom * b


def support(grey: np.ndarray, plane: np.ndarray, tolerance: float) -> np.ndarray:
    """Return (H, W) shares of the pixels in each pixel's cross that continue its surface, see `stereo_ops.support`."""
    height, width = grey.shape
    grey, plane = grey.astype(int), plane.astype(np.float64)
    share = np.zeros(grey.shape)
    for row, column in np.argwhere(plane[0] > 0):
        y, x = _cross(grey, row, column)
        inverse, right, down = plane[:, row, column]
        here = inverse + right * (x - column) + down * (y - row)
        there, their_right, their_down = plane[:, y, x]
        back = there - their_right * (x - column) - their_down * (y - row)
        goes_on = (np.abs(there - here) < tolerance * here) | (np.abs(inverse - back) < tolerance * back)
        share[row, column] = (goes_on & (there > 0)).mean()
    return share


def fit_surfaces(
    grey: np.ndarray, plane: np.ndarray, cost: np.ndarray, tolerance: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the (3, H, W) planes and (H, W) costs that `stereo_ops.fit_surfaces` computes from (3, H, W) planes, whose
    inverse depth is 0 where unknown."""
    grey, plane = grey.astype(int), plane.astype(np.float64)
    fitted, fitted_cost = plane.copy(), cost.astype(np.float64)
    tolerances = tolerance / 2.0 ** np.arange(SCALES)
    for row, column in np.ndindex(grey.shape):
        y, x = _cross(grey, row, column)
        inverse, right, down = plane[:, y, x]
        dy, dx = y - row, x - column
        own, start, most = plane[:, row, column], None, 0
        tried = np.flatnonzero((dx % CANDIDATE_STEP == 0) & (dy % CANDIDATE_STEP == 0) & (inverse > 0))
        others = np.stack([inverse - right * dx - down * dy, right, down], axis=1)[tried]
        for candidate in [own, *others[others[:, 0] > 0]]:
            there = candidate[0] + candidate[1] * dx + candidate[2] * dy
            counts = (np.abs(inverse - there) < tolerances[:, None] * there).sum(1)
            if counts[0] > len(x) // 2 and counts.sum() > most:
                start, most = candidate, counts.sum()
                narrowest = tolerances[(counts > len(x) // 2).sum() - 1]
        if start is None:
            continue
        if abs(own[0] - start[0]) >= tolerance * start[0]:
            there = start[0] + start[1] * dx + start[2] * dy
            fitted_cost[row, column] = cost[y, x][np.abs(inverse - there) < tolerance * there].mean()
        y, x = (
            np.arange(max(middle - CROSS_REACH, 0), min(middle + CROSS_REACH + 1, end))
            for middle, end in zip((row, column), grey.shape, strict=True)
        )
        y, x = np.meshgrid(y, x, indexing="ij")
        inverse, dy, dx = plane[0, y, x].ravel(), y.ravel() - row, x.ravel() - column
        terms = np.stack([np.ones(len(dx)), dx, dy, dx**2, dx * dy, dy**2], axis=1)
        surface, enough = np.append(start, np.zeros(3)), True
        for _ in range(FIT_ROUNDS):
            there = terms @ surface
            near = np.abs(inverse - there) < narrowest * there
            enough &= near.sum() >= FEWEST_FITTED
            if enough:
                surface = surface + _least_squares(terms[near], (inverse - there)[near])
        taken = enough and abs(surface[0] - start[0]) < tolerance * start[0]
        fitted[:, row, column] = (surface if taken else start)[:3]
    return fitted, fitted_cost


def _least_squares(terms: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return (T,) coefficients of (N, T) terms, 0 for terms that earlier ones explain."""
    kept: list[int] = []
    for k, column in enumerate(terms.T):
        left = column - terms[:, kept] @ np.linalg.lstsq(terms[:, kept], column, rcond=None)[0] if kept else column
        if left @ left > TERM_LEFT * (column @ column):
            kept.append(k)
    solution = np.zeros(terms.shape[1])
    solution[kept] = np.linalg.lstsq(terms[:, kept], values, rcond=None)[0]
    return solution


def _cross(grey: np.ndarray, row: int, column: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the rows and columns of the pixels in the cross of a pixel."""
    y, x = np.array([(y, x) for y in _alike(grey[:, column], row) for x in _alike(grey[y], column)]).T
    return y, x


def _alike(line: np.ndarray, middle: int) -> range:
    """Return the range of positions along a line of grey values, around the middle, that belong to its cross."""
    ends = []
    for step in (-1, 1):
        place = middle
        while (
            abs(place + step - middle) <= CROSS_REACH
            and 0 <= place + step < len(line)
            and abs(line[place + step] - line[middle]) < CROSS_GREY
        ):
            place += step
        ends.append(place)
    return range(ends[0], ends[1] + 1)


def compare_shading(
    rays: np.ndarray,
    value: np.ndarray,
    plane: np.ndarray,
    moves: np.ndarray,
    own: Camera,
    other: Camera,
    means: np.ndarray,
    plain: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, float, float, np.ndarray, np.ndarray]:
    """Return `shown`, `left`, `left_variance`, `variance`, `information` and `downhill` of
    `stereo_ops.ShadedComparison`."""
    points = own.center + (rays / (rays @ plane)[:, None]) @ own.rotation
    pixels, along = other.project(points)
    height, width = plain.shape
    x, y = (pixels - 0.5).T
    shown = (rays @ plane > 0) & (along > 0) & (x >= 0) & (y >= 0) & (x < width - 1) & (y < height - 1)
    shown[shown] = plain[np.rint(y[shown]).astype(int), np.rint(x[shown]).astype(int)]
    rays, ours = rays[shown], value[shown]

    def seen(plane: np.ndarray) -> np.ndarray:
        return other.project(own.center + (rays / (rays @ plane)[:, None]) @ own.rotation)[0]

    theirs, by_column, by_row = (_at(means[..., k], seen(plane)) for k in range(3))
    weight = np.ones(len(ours))
    for _ in range(ROUNDS):
        a, b = (values - np.average(values, weights=weight) for values in (ours, theirs))
        gain = np.clip((weight * a * b).sum() / (weight * b * b).sum(), *GAINS)
        along = (weight * b**3).sum() / (weight * b * b).sum()
        square = b * b - (weight * b * b).sum() / weight.sum() - along * b
        bend = (weight * square * a).sum() / (weight * square**2).sum()
        left = a - gain * b - bend * square
        deviation = 1.4826 * np.sort(np.abs(left))[len(left) // 2] + 0.05
        weight = 1 / np.maximum(1, np.abs(left) / (2 * deviation))
    step = 1e-6
    slopes = []
    for move in moves.T:
        moved = (seen(plane + step * move) - seen(plane - step * move)) / (2 * step)
        slopes.append(by_column * moved[:, 0] + by_row * moved[:, 1])
    root = np.sqrt(weight)
    slope = np.stack(slopes, 1) * ((gain + bend * (2 * b - along)) * root)[:, None]
    taken = np.linalg.qr(np.stack([np.ones_like(theirs), theirs, theirs**2], 1) * root[:, None])[0]
    slope -= taken @ (taken.T @ slope)
    variance = (weight * left**2).mean() + 1e-4
    whole = np.zeros(len(shown))
    whole[shown] = left
    downhill = slope.T @ (left * root) / variance
    return shown, whole, variance, ours.var(), slope.T @ slope / variance, downhill


def _at(image: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Return bilinear values of an image at positions; pixel centres are at +0.5."""
    x, y = (pixels - 0.5).T
    left, top = np.floor(x).astype(int), np.floor(y).astype(int)
    u, v = x - left, y - top
    upper = image[top, left] * (1 - u) + image[top, left + 1] * u
    lower = image[top + 1, left] * (1 - u) + image[top + 1, left + 1] * u
    return upper * (1 - v) + lower * v
