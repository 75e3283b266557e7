//! Fits cell models to measured data (paper, section 3.3.2): pure arithmetic, no files.
