//! Computes exponential and logarithm without branches, so that the compiler can vectorise the loops.
//!
//! Each function states the range of its argument. Within this range, the relative error of the result is a few 1e-16.
//! Outside, the result is meaningless. The calling loops run inside `pulp`'s dispatcher (part of faer), which selects
//! the widest vector instructions of the machine at run time. Multiplications and additions are not fused, so that the
//! results are the same on every machine.

use std::f64::consts::LOG2_E;

/// ln 2 as the sum of two numbers. The first has so few bits that its product with an exponent is exact.
const LN2_HIGH: f64 = 6.931_471_803_691_238e-1;
const LN2_LOW: f64 = 1.908_214_929_270_587_7e-10;
/// After adding this number to a small number, the low bits of the sum contain the nearest integer.
const ROUNDER: f64 = 6_755_399_441_055_744.0;
/// 1/k! for k = 13 down to 0.
const EXP_SERIES: [f64; 14] = [
    1.605_904_383_682_161_3e-10,
    2.087_675_698_786_81e-9,
    2.505_210_838_544_172e-8,
    2.755_731_922_398_589_3e-7,
    2.755_731_922_398_589e-6,
    2.480_158_730_158_73e-5,
    1.984_126_984_126_984e-4,
    1.388_888_888_888_889e-3,
    8.333_333_333_333_333e-3,
    4.166_666_666_666_666_4e-2,
    1.666_666_666_666_666_6e-1,
    0.5,
    1.0,
    1.0,
];

/// Returns exp(x) for x <= 0. For x < -700, the result is exp(-700).
#[inline(always)]
pub(crate) fn exp(x: f64) -> f64 {
    // exp(-700) is about 1e-304, far above the subnormal numbers.
    let x = x.max(-700.0);
    let rounded = x * LOG2_E + ROUNDER;
    let whole = rounded - ROUNDER;
    let rest = (x - whole * LN2_HIGH) - whole * LN2_LOW;
    let mut series = EXP_SERIES[0];
    for term in &EXP_SERIES[1..] {
        series = series * rest + term;
    }
    series * f64::from_bits(rounded.to_bits().wrapping_add(1023) << 52)
}

/// Returns ln(x) for finite x >= 1.
#[inline(always)]
pub(crate) fn ln(x: f64) -> f64 {
    const MANTISSA: u64 = (1 << 52) - 1;
    let bits = x.to_bits();
    // The exponent bits of `x` (exponent + 1023), combined with the bits of 2^52, represent 2^52 + 1023 + exponent.
    // Subtracting 2^52 + 1023 gives the exponent.
    let exponent = f64::from_bits((bits >> 52) | 0x4330_0000_0000_0000) - (4_503_599_627_370_496.0 + 1023.0);
    let mantissa = f64::from_bits((bits & MANTISSA) | 0x3ff0_0000_0000_0000);
    let halve = mantissa > std::f64::consts::SQRT_2;
    let mantissa = if halve { 0.5 * mantissa } else { mantissa };
    let exponent = if halve { exponent + 1.0 } else { exponent };
    let f = (mantissa - 1.0) / (mantissa + 1.0);
    let s = f * f;
    let mut series = 1.0 / 21.0;
    for odd in [19.0, 17.0, 15.0, 13.0, 11.0, 9.0, 7.0, 5.0, 3.0] {
        series = series * s + 1.0 / odd;
    }
    exponent * LN2_HIGH + (exponent * LN2_LOW + 2.0 * f * (1.0 + s * series))
}

#[cfg(test)]
mod tests {
    use super::{exp, ln};

    #[test]
    fn exp_and_ln_agree_with_the_standard_library() {
        for k in 0..400_000_u32 {
            let x = -690.0 * (f64::from(k) / 400_000.0).powi(3);
            assert!((exp(x) / x.exp() - 1.0).abs() < 4e-16, "exp({x}) = {}", exp(x));
            let y = 1.0 + 1e-6 * f64::from(k) * f64::from(k);
            assert!((ln(y) - y.ln()).abs() <= 8e-16 * y.ln(), "ln({y}) = {}", ln(y));
        }
        assert_eq!((exp(0.0), ln(1.0)), (1.0, 0.0));
        assert!(exp(-1e300) < 1e-300);
    }
}
