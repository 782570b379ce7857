//! Divides by a constant with a multiplication and a shift.

/// Division by a divisor below 2^32, rounded to nearest, half up.
#[derive(Clone, Copy, Debug)]
pub(super) struct RoundedDivision {
    half: u64,
    /// 2^63 times the largest power of 2 that is not above the divisor, divided by it and rounded
    /// up.
    reciprocal: u64,
    shift: u32,
}

impl RoundedDivision {
    /// Creates the division by `divisor`, 1 to 2^32 - 1.
    pub(super) fn to(divisor: u64) -> Self {
        let shift = divisor.ilog2();
        let reciprocal = (1_u128 << (63 + shift)).div_ceil(u128::from(divisor)) as u64;
        Self { half: divisor / 2, reciprocal, shift }
    }

    /// Divides `sum`, which is at most 255 times the divisor.
    ///
    /// The reciprocal is too large by less than `divisor` / 2^(63 + shift), so the quotient is by
    /// less than 1 / `divisor`, and none that is not whole reaches the next whole number: `sum` *
    /// `divisor` < 2^8 * 2^(2 * (shift + 1)) < 2^(63 + shift).
    ///
    /// Source: T. Granlund and P. Montgomery, Division by Invariant Integers using Multiplication,
    /// 1994.
    pub(super) fn divide(self, sum: u64) -> u8 {
        let twice = sum.wrapping_add(self.half) << 1;
        let high = (u128::from(twice) * u128::from(self.reciprocal)) >> 64;
        (high as u64 >> self.shift) as u8
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_equals_division_around_every_step() {
        let small = 1..=300;
        let powers = (0..32).flat_map(|power| [(1 << power) - 1, 1 << power, (1 << power) + 1]);
        let large =
            [65_535 * 65_535, (1 << 32) - 1, 16_384 * 16_384 * 4, 65_535 * 32_768, 4_294_967_291];
        for divisor in
            small.chain(powers).chain(large).filter(|divisor| (1..1 << 32).contains(divisor))
        {
            let rounded = RoundedDivision::to(divisor);
            for whole in 0..=255 {
                let step = whole * divisor;
                for sum in [
                    step.saturating_sub(divisor / 2 + 1),
                    step.saturating_sub(divisor / 2),
                    step,
                    step + divisor / 2,
                ] {
                    let expected = (sum + divisor / 2) / divisor;
                    if expected <= 255 {
                        assert_eq!(u64::from(rounded.divide(sum)), expected, "{sum} / {divisor}");
                    }
                }
            }
        }
    }
}
