//! Splits bytes into numbers and choices. Bytes after the end read as zero, so an input of any length is valid.

pub(super) struct Source<'a> {
    bytes: &'a [u8],
}

impl<'a> Source<'a> {
    pub(super) fn new(bytes: &'a [u8]) -> Self {
        Self { bytes }
    }

    pub(super) fn is_empty(&self) -> bool {
        self.bytes.is_empty()
    }

    pub(super) fn rest(&mut self) -> &'a [u8] {
        std::mem::take(&mut self.bytes)
    }

    pub(super) fn array<const N: usize>(&mut self) -> [u8; N] {
        let count = N.min(self.bytes.len());
        let (taken, rest) = self.bytes.split_at(count);
        self.bytes = rest;
        let mut array = [0; N];
        array[..count].copy_from_slice(taken);
        array
    }

    pub(super) fn byte(&mut self) -> u8 {
        self.array::<1>()[0]
    }

    pub(super) fn u16(&mut self) -> u16 {
        u16::from_le_bytes(self.array())
    }

    pub(super) fn i16(&mut self) -> i16 {
        i16::from_le_bytes(self.array())
    }

    pub(super) fn one_of<T: Copy>(&mut self, choices: &[T]) -> T {
        choices[usize::from(self.byte()) % choices.len()]
    }

    /// Returns a plausible number, a number of random magnitude, a special value, or a number from arbitrary bits.
    pub(super) fn number(&mut self) -> f64 {
        match self.byte() % 4 {
            0 => f64::from(self.i16()) / 100.0,
            1 => f64::from(self.i16()) * 10.0_f64.powi(i32::from(self.byte() % 40) - 20),
            2 => self.one_of(&[
                0.0,
                -0.0,
                1.0,
                -1.0,
                1e-300,
                1e300,
                f64::MIN_POSITIVE,
                f64::MAX,
                f64::INFINITY,
                f64::NAN,
                0.5,
                1e-9,
                1e9,
            ]),
            _ => f64::from_le_bytes(self.array()),
        }
    }
}
