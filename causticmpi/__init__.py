"""causticmpi: unbiased global illumination with caustics, rendered in batch on many cores.

L = L_d + L_c: Illumination by Weak Singularities gives L_d, Caustic Forecasting gives L_c
[Budge, Anderson, Joy: Caustic Forecasting, Pacific Graphics 2008; "CF" below].
"""

__version__ = "0.1.0"
