//! Arithmetic on L numbers at once, for filters that step several cells together.
//!
//! Every operation treats each lane separately, with a fixed order of IEEE 754 operations (no fused multiply-add, no
//! library function). A lane's result therefore has the same bits for any L, any other lanes and any instruction width.
//! The compiler vectorises the loops. NaN and infinities follow IEEE 754 unless a method states otherwise.

use std::ops::{Add, BitAnd, Div, Mul, Neg, Not, Sub};

/// L numbers, one per lane.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Lanes<const L: usize>(pub [f64; L]);

/// L booleans, one per lane: all 64 bits set for true, no bit for false.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Mask<const L: usize>([u64; L]);

/// A number that fills a new array before the lanes are computed.
trait Zero: Copy {
    const ZERO: Self;
}

impl Zero for f64 {
    const ZERO: Self = 0.0;
}

impl Zero for u64 {
    const ZERO: Self = 0;
}

/// Replaces the standard library's `from_fn`, which is not inlined into long callers and makes a replay of one cell 9 %
/// slower. The wide filter step has eight lanes. They are written one by one, because with thousands of short loops the
/// compiler needs 26 s for each of its six copies, and 60 s for the rest of this crate.
#[inline(always)]
fn from_fn<T: Zero, const L: usize>(mut lane: impl FnMut(usize) -> T) -> [T; L] {
    let mut lanes = [T::ZERO; L];
    if L == 8 {
        lanes[0] = lane(0);
        lanes[1] = lane(1);
        lanes[2] = lane(2);
        lanes[3] = lane(3);
        lanes[4] = lane(4);
        lanes[5] = lane(5);
        lanes[6] = lane(6);
        lanes[7] = lane(7);
        return lanes;
    }
    for (index, place) in lanes.iter_mut().enumerate() {
        *place = lane(index);
    }
    lanes
}

macro_rules! arithmetic {
    ($trait:ident, $method:ident, $op:tt) => {
        impl<const L: usize> $trait for Lanes<L> {
            type Output = Self;

            #[inline(always)]
            fn $method(self, other: Self) -> Self {
                Self(from_fn(|i| self.0[i] $op other.0[i]))
            }
        }

        impl<const L: usize> $trait<f64> for Lanes<L> {
            type Output = Self;

            #[inline(always)]
            fn $method(self, other: f64) -> Self {
                Self(from_fn(|i| self.0[i] $op other))
            }
        }
    };
}

arithmetic!(Add, add, +);
arithmetic!(Sub, sub, -);
arithmetic!(Mul, mul, *);
arithmetic!(Div, div, /);

impl<const L: usize> Neg for Lanes<L> {
    type Output = Self;

    #[inline(always)]
    fn neg(self) -> Self {
        Self(from_fn(|i| -self.0[i]))
    }
}

impl<const L: usize> BitAnd for Mask<L> {
    type Output = Self;

    #[inline(always)]
    fn bitand(self, other: Self) -> Self {
        Self(from_fn(|i| self.0[i] & other.0[i]))
    }
}

impl<const L: usize> Not for Mask<L> {
    type Output = Self;

    #[inline(always)]
    fn not(self) -> Self {
        Self(from_fn(|i| !self.0[i]))
    }
}

impl<const L: usize> Mask<L> {
    #[inline(always)]
    fn from_fn(mut predicate: impl FnMut(usize) -> bool) -> Self {
        Self(from_fn(|i| if predicate(i) { u64::MAX } else { 0 }))
    }

    /// The same value in every lane.
    #[inline(always)]
    pub const fn splat(value: bool) -> Self {
        Self([if value { u64::MAX } else { 0 }; L])
    }

    /// Value of a lane.
    #[inline(always)]
    pub fn lane(self, lane: usize) -> bool {
        self.0[lane] != 0
    }

    /// Sets the value of a lane.
    #[inline(always)]
    pub fn set_lane(&mut self, lane: usize, value: bool) {
        self.0[lane] = if value { u64::MAX } else { 0 };
    }

    /// Whether every lane is true.
    #[inline(always)]
    pub fn all(self) -> bool {
        self.0.iter().fold(u64::MAX, |all, lane| all & lane) != 0
    }

    /// Whether exactly one lane is true.
    #[inline(always)]
    pub fn is_one(self) -> bool {
        // As an integer, a true lane is -1.
        self.0.iter().fold(0, |sum: u64, lane| sum.wrapping_add(*lane)) == u64::MAX
    }

    /// Whether any lane is true.
    #[inline(always)]
    pub fn any(self) -> bool {
        self.0.iter().fold(0, |any, lane| any | lane) != 0
    }
}

impl<const L: usize> Lanes<L> {
    /// The same number in every lane.
    #[inline(always)]
    pub fn splat(value: f64) -> Self {
        Self([value; L])
    }

    /// Square of each lane.
    #[inline(always)]
    pub fn square(self) -> Self {
        self * self
    }

    /// Square root; NaN below 0.
    #[inline(always)]
    pub fn sqrt(self) -> Self {
        Self(from_fn(|i| self.0[i].sqrt()))
    }

    /// 1 / x.
    #[inline(always)]
    pub fn reciprocal(self) -> Self {
        Self(from_fn(|i| 1.0 / self.0[i]))
    }

    /// Magnitude of each lane.
    #[inline(always)]
    pub fn abs(self) -> Self {
        Self(from_fn(|i| self.0[i].abs()))
    }

    /// The smaller value in each lane; the value of `other` if the lane of `self` is NaN.
    #[inline(always)]
    pub fn smaller(self, other: Self) -> Self {
        Self(from_fn(|i| if self.0[i] < other.0[i] { self.0[i] } else { other.0[i] }))
    }

    /// At most `limit`; `limit` where the lane is NaN.
    #[inline(always)]
    pub fn at_most(self, limit: f64) -> Self {
        Self(from_fn(|i| if self.0[i] < limit { self.0[i] } else { limit }))
    }

    /// At least `limit`; `limit` where the lane is NaN.
    #[inline(always)]
    pub fn at_least(self, limit: f64) -> Self {
        Self(from_fn(|i| if self.0[i] > limit { self.0[i] } else { limit }))
    }

    /// Whether each lane is greater than the lane of `other`; false for NaN.
    #[inline(always)]
    pub fn above(self, other: Self) -> Mask<L> {
        Mask::from_fn(|i| self.0[i] > other.0[i])
    }

    /// Whether each lane is greater than `limit`; false for NaN.
    #[inline(always)]
    pub fn above_number(self, limit: f64) -> Mask<L> {
        Mask::from_fn(|i| self.0[i] > limit)
    }

    /// Whether each lane is neither NaN nor infinite.
    #[inline(always)]
    pub fn is_finite(self) -> Mask<L> {
        Mask::from_fn(|i| self.0[i].abs() < f64::INFINITY)
    }

    /// Takes each lane from `self` where the mask is true, otherwise from `other`.
    #[inline(always)]
    pub fn or_else(self, mask: Mask<L>, other: Self) -> Self {
        Self(from_fn(|i| if mask.0[i] != 0 { self.0[i] } else { other.0[i] }))
    }

    /// e^x with a relative error below 3 x 2^-52. Returns 0 for x <= -708, and e^709 for x > 709 or NaN.
    #[inline(always)]
    pub fn exp(self) -> Self {
        let x = self.at_most(709.0);
        let series = ExpSeries::new(x.at_least(LEAST));
        let scaled = series.scaled(series.even + series.odd, |bits, exponent| bits.wrapping_add(exponent));
        scaled.or_else(x.above_number(LEAST), Self::splat(0.0))
    }

    /// e^x and e^-x, with a relative error below 3 x 2^-52. x is first limited to -708 to 708; a NaN counts as 708.
    #[inline(always)]
    pub fn exp_of_both_signs(self) -> (Self, Self) {
        let series = ExpSeries::new(self.at_most(-LEAST).at_least(LEAST));
        (
            series.scaled(series.even + series.odd, |bits, exponent| bits.wrapping_add(exponent)),
            series.scaled(series.even - series.odd, |bits, exponent| bits.wrapping_sub(exponent)),
        )
    }

    /// ln x for a normal, positive x. The error is at most 2 x 2^-52 times |ln x|, or 2 x 2^-52 times 1e-3 if |ln x| is
    /// smaller than 1e-3.
    #[inline(always)]
    pub fn ln(self) -> Self {
        Self(from_fn(|i| ln(self.0[i])))
    }
}

/// Parts of e^x: x = n ln 2 + r with |r| <= ln 2 / 2. e^r is computed from its Taylor series up to r^12 / 12!
/// (truncation error below 2e-16).
struct ExpSeries<const L: usize> {
    /// A floating-point number whose lowest bits contain n.
    shifted: Lanes<L>,
    even: Lanes<L>,
    odd: Lanes<L>,
}

impl<const L: usize> ExpSeries<L> {
    #[inline(always)]
    fn new(x: Lanes<L>) -> Self {
        let shifted = x * std::f64::consts::LOG2_E + ROUNDER;
        let n = shifted - ROUNDER;
        let r = (x - n * LN_2_HIGH) - n * LN_2_LOW;
        // Two short dependency chains are faster than one long chain, so even and odd powers are summed separately.
        let r2 = r.square();
        let even = EXP_EVEN.iter().fold(Lanes::splat(1.0 / 479_001_600.0), |sum, factor| sum * r2 + *factor);
        let odd = EXP_ODD.iter().fold(Lanes::splat(1.0 / 39_916_800.0), |sum, factor| sum * r2 + *factor);
        Self { shifted, even, odd: odd * r }
    }

    /// Multiplies `sum` by 2^n or 2^-n: `change` adds n to the exponent bits or subtracts n.
    #[inline(always)]
    fn scaled(&self, sum: Lanes<L>, change: fn(u64, u64) -> u64) -> Lanes<L> {
        // The shift drops the bits above n.
        Lanes(from_fn(|i| f64::from_bits(change(sum.0[i].to_bits(), self.shifted.0[i].to_bits() << 52))))
    }
}

/// ln x from x = m 2^e with sqrt(1/2) <= m < sqrt(2). With s = (m - 1) / (m + 1), ln m = 2 (s + s^3/3 + s^5/5 + ...).
#[inline(always)]
fn ln(x: f64) -> f64 {
    // Subtracting the bits of sqrt(1/2) leaves e in the exponent field.
    let above = x.to_bits().wrapping_sub(SQRT_HALF_BITS);
    let exponent = above & 0xFFF0_0000_0000_0000;
    let m = f64::from_bits(x.to_bits().wrapping_sub(exponent));
    // Convert e to a float without an integer conversion: put its low bits into the mantissa of a large number.
    let biased = (exponent >> 52).wrapping_add(2048) & 0xFFF;
    let e = f64::from_bits(LARGE.to_bits() | biased) - (LARGE + 2048.0);
    let s = (m - 1.0) / (m + 1.0);
    let s2 = s * s;
    let series = LN_SERIES.iter().fold(1.0 / 21.0, |sum, factor| sum * s2 + factor);
    2.0 * s * series + e * std::f64::consts::LN_2
}

/// At and below this x, [`Lanes::exp`] returns 0, because e^x would be subnormal.
const LEAST: f64 = -708.0;
/// Adding this number to x (|x| < 2^51) rounds x to an integer.
const ROUNDER: f64 = 6_755_399_441_055_744.0; // 1.5 * 2^52
/// 2^52.
const LARGE: f64 = 4_503_599_627_370_496.0;
const SQRT_HALF_BITS: u64 = std::f64::consts::FRAC_1_SQRT_2.to_bits();
/// ln 2 in two parts. The first part has only 32 significant bits, so that its product with a small integer is exact.
const LN_2_HIGH: f64 = f64::from_bits(0x3FE6_2E42_FEE0_0000);
const LN_2_LOW: f64 = f64::from_bits(0x3DEA_39EF_3579_3C76);

/// 1/10!, 1/8!, ..., 1/0!.
const EXP_EVEN: [f64; 6] = [1.0 / 3_628_800.0, 1.0 / 40_320.0, 1.0 / 720.0, 1.0 / 24.0, 0.5, 1.0];
/// 1/9!, 1/7!, ..., 1/1!.
const EXP_ODD: [f64; 5] = [1.0 / 362_880.0, 1.0 / 5_040.0, 1.0 / 120.0, 1.0 / 6.0, 1.0];

/// 1/19, 1/17, ..., 1/1.
const LN_SERIES: [f64; 10] =
    [1.0 / 19.0, 1.0 / 17.0, 1.0 / 15.0, 1.0 / 13.0, 1.0 / 11.0, 1.0 / 9.0, 1.0 / 7.0, 1.0 / 5.0, 1.0 / 3.0, 1.0];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exp_agrees_with_the_library() {
        let mut x = -745.0;
        while x < 709.0 {
            let (ours, theirs) = (Lanes([x]).exp().0[0], libm::exp(x));
            let close = (ours - theirs).abs() <= 3.0 * f64::EPSILON * theirs;
            assert!(close || (x <= LEAST && ours == 0.0), "{x}: {ours} {theirs}");
            x += 0.0137;
        }
        assert_eq!(Lanes([0.0, -0.0, f64::NEG_INFINITY, -1e300]).exp(), Lanes([1.0, 1.0, 0.0, 0.0]));
        assert!(Lanes([1e300]).exp().0[0].is_finite());
    }

    #[test]
    fn exp_of_both_signs_agrees_with_libm() {
        let mut x = -708.0;
        while x <= 708.0 {
            let (up, down) = Lanes([x]).exp_of_both_signs();
            for (ours, theirs) in [(up.0[0], libm::exp(x)), (down.0[0], libm::exp(-x))] {
                assert!((ours - theirs).abs() <= 3.0 * f64::EPSILON * theirs, "{x}: {ours} {theirs}");
            }
            x += 0.0137;
        }
        let (up, down) = Lanes([0.0, 1e300, -1e300, f64::NAN]).exp_of_both_signs();
        assert_eq!((up.0[0], down.0[0]), (1.0, 1.0));
        assert_eq!((up.0[1], down.0[1]), (down.0[2], up.0[2]));
        assert!(up.0.iter().chain(&down.0).all(|x| x.is_finite() && *x > 0.0));
    }

    #[test]
    fn masks_are_counted_lane_by_lane() {
        let mut mask = Lanes([1.0, f64::NAN, -1.0, f64::INFINITY]).above_number(0.0);
        assert_eq!([0, 1, 2, 3].map(|lane| mask.lane(lane)), [true, false, false, true]);
        assert_eq!((mask.any(), mask.is_one(), mask.all()), (true, false, false));
        mask.set_lane(3, false);
        assert_eq!((mask.any(), mask.is_one(), mask.all()), (true, true, false));
        mask.set_lane(0, false);
        assert_eq!((mask.any(), mask.is_one(), mask.all()), (false, false, false));
        assert_eq!(((!mask).all(), Mask::<4>::splat(true)), (true, !mask));
        assert_eq!(
            Lanes([1.0, 2.0]).or_else(Lanes([0.0, 1.0]).above_number(0.5), Lanes([7.0, 8.0])),
            Lanes([7.0, 2.0])
        );
    }

    #[test]
    fn ln_agrees_with_the_library() {
        let mut x = 1e-12_f64;
        while x < 1e12 {
            for x in [x, 1.0 + x.min(1.0)] {
                let (ours, theirs) = (Lanes([x]).ln().0[0], libm::log(x));
                assert!((ours - theirs).abs() <= 2.0 * f64::EPSILON * theirs.abs().max(1e-3), "{x}: {ours} {theirs}");
            }
            x *= 1.0171;
        }
        assert_eq!(Lanes([1.0]).ln(), Lanes([0.0]));
    }

    #[test]
    fn lane_is_independent_of_its_neighbours() {
        let x = [0.3, -2.0, f64::NAN, 1e9, 7.5, 0.0, -1e-9, 55.0];
        let all = Lanes(x).exp() * Lanes(x).sqrt() + Lanes(x).at_most(3.0).reciprocal();
        for (i, x) in x.into_iter().enumerate() {
            let alone = Lanes([x]).exp() * Lanes([x]).sqrt() + Lanes([x]).at_most(3.0).reciprocal();
            assert_eq!(alone.0[0].to_bits(), all.0[i].to_bits());
        }
    }
}
