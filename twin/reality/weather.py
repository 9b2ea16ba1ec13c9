"""The lightings of the real test. None of them is ever filmed, and nothing but a trial may know them.

The sun stands elsewhere than in any film, its light has other colours, the air is hazy or the ground wet. Stated here
and drawn once: what a trial adds of its own is only the camera's drift of exposure.
"""

from twin.reality.lighting import Lighting

WEATHER: dict[str, Lighting] = {
    lighting.name: lighting
    for lighting in (
        Lighting(
            "dawn",
            ambient=(0.36, 0.37, 0.47),
            suns=(((-0.72, -0.52, -0.42), (0.86, 0.58, 0.36), True), ((0.5, 0.4, -0.8), (0.10, 0.11, 0.16), False)),
            zenith=(0.34, 0.46, 0.70),
            horizon=(0.95, 0.76, 0.60),
            clouds=0.35,
            cloud=(0.93, 0.76, 0.70),
            skyline=(0.26, 0.27, 0.30),
            occlusion=0.6,
            glow_sun=(0.5, 0.34, 0.18),
            exposure=1.6,
            noise=0.005,
            gain=(1.02, 1.0, 0.98),
        ),
        Lighting(
            "afternoon",
            ambient=(0.42, 0.45, 0.52),
            suns=(((0.66, 0.18, -0.62), (1.02, 0.90, 0.70), True), ((-0.5, 0.4, -0.5), (0.10, 0.11, 0.14), False)),
            zenith=(0.26, 0.45, 0.76),
            horizon=(0.78, 0.83, 0.88),
            clouds=0.55,
            cloud=(0.94, 0.93, 0.92),
            skyline=(0.32, 0.38, 0.34),
            occlusion=0.5,
            glow_sun=(0.4, 0.34, 0.24),
            exposure=1.15,
            noise=0.003,
        ),
        Lighting(
            "evening",
            ambient=(0.28, 0.27, 0.36),
            suns=(((0.50, -0.78, -0.30), (0.66, 0.38, 0.22), True), ((-0.3, 0.1, -1.0), (0.12, 0.12, 0.18), False)),
            zenith=(0.18, 0.22, 0.44),
            horizon=(0.90, 0.52, 0.36),
            clouds=0.6,
            cloud=(0.66, 0.44, 0.46),
            skyline=(0.15, 0.14, 0.19),
            occlusion=0.7,
            lamps=(0.34, 0.27, 0.16),
            glow=0.8,
            exposure=1.7,
            noise=0.007,
            gain=(1.03, 1.0, 0.97),
        ),
        Lighting(
            "haze",
            ambient=(0.56, 0.57, 0.59),
            suns=(((-0.55, 0.20, -0.60), (0.34, 0.32, 0.28), True), ((0.4, -0.3, -0.8), (0.10, 0.10, 0.11), False)),
            zenith=(0.72, 0.76, 0.80),
            horizon=(0.86, 0.86, 0.85),
            clouds=0.5,
            cloud=(0.86, 0.86, 0.86),
            skyline=(0.72, 0.74, 0.74),
            occlusion=0.8,
            visibility=60.0,
            exposure=1.1,
            noise=0.004,
        ),
        Lighting(
            "rain",
            ambient=(0.40, 0.43, 0.48),
            suns=(((0.1, 0.2, -1.0), (0.24, 0.25, 0.27), False), ((-0.6, 0.5, -0.4), (0.07, 0.07, 0.08), False)),
            zenith=(0.46, 0.49, 0.54),
            horizon=(0.62, 0.64, 0.67),
            clouds=1.0,
            cloud=(0.50, 0.52, 0.56),
            skyline=(0.36, 0.39, 0.41),
            occlusion=1.0,
            wet=0.35,
            visibility=130.0,
            lamps=(0.10, 0.08, 0.05),
            glow=0.5,
            exposure=1.45,
            noise=0.007,
            gain=(0.97, 1.0, 1.04),
        ),
    )
}
"""By name."""
