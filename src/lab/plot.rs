//! Plots of estimates and residuals, as SVG.
