//! The NAME of J1939-81: 64 bits that identify a node. If two nodes claim the same address, the smaller NAME wins.

use std::fmt;

use serde::{Deserialize, Serialize};

/// A NAME.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Name(u64);

/// Fields of a NAME.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct NameFields {
    /// packwatch never claims another address after losing its own.
    pub arbitrary_address_capable: bool,
    /// 3 bits: 0 global, 1 on-highway, 2 agriculture, 3 construction, 4 marine, 5 industrial.
    pub industry_group: u8,
    /// 4 bits.
    pub vehicle_system_instance: u8,
    /// 7 bits, 127 = not available.
    pub vehicle_system: u8,
    /// 8 bits, 255 = not available.
    pub function: u8,
    /// 5 bits.
    pub function_instance: u8,
    /// 3 bits.
    pub ecu_instance: u8,
    /// 11 bits, assigned by SAE.
    pub manufacturer_code: u16,
    /// 21 bits, unique for the manufacturer.
    pub identity_number: u32,
}

/// Reports a number outside its allowed range.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("{field} = {found}, must be {lowest} to {highest}")]
pub struct OutOfRange {
    pub field: &'static str,
    pub found: u64,
    pub lowest: u64,
    pub highest: u64,
}

impl Name {
    /// Builds a NAME. Fails at the first field that does not fit its bits.
    pub fn new(fields: &NameFields) -> Result<Self, OutOfRange> {
        // From the lowest bit up, as in J1939-81, table 1.
        let parts: [(&'static str, u64, u32); 10] = [
            ("identity_number", fields.identity_number.into(), 21),
            ("manufacturer_code", fields.manufacturer_code.into(), 11),
            ("ecu_instance", fields.ecu_instance.into(), 3),
            ("function_instance", fields.function_instance.into(), 5),
            ("function", fields.function.into(), 8),
            ("reserved", 0, 1),
            ("vehicle_system", fields.vehicle_system.into(), 7),
            ("vehicle_system_instance", fields.vehicle_system_instance.into(), 4),
            ("industry_group", fields.industry_group.into(), 3),
            ("arbitrary_address_capable", fields.arbitrary_address_capable.into(), 1),
        ];
        let (mut name, mut at) = (0, 0);
        for (field, found, bits) in parts {
            let highest = (1 << bits) - 1;
            if found > highest {
                return Err(OutOfRange { field, found, lowest: 0, highest });
            }
            name |= found << at;
            at += bits;
        }
        Ok(Self(name))
    }

    /// The NAME from received bytes.
    pub const fn from_bytes(bytes: [u8; 8]) -> Self {
        Self(u64::from_le_bytes(bytes))
    }

    /// The bytes, lowest first.
    pub const fn to_bytes(self) -> [u8; 8] {
        self.0.to_le_bytes()
    }

    /// The NAME as a number; the smaller number wins.
    pub const fn raw(self) -> u64 {
        self.0
    }
}

impl fmt::Display for Name {
    /// 16 hexadecimal digits.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:016X}", self.0)
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn each_field_has_its_bits() {
        let none = NameFields::default();
        let cases = [
            (NameFields { identity_number: 0x1F_FFFF, ..none }, 0x0000_0000_001F_FFFF),
            (NameFields { manufacturer_code: 0x7FF, ..none }, 0x0000_0000_FFE0_0000),
            (NameFields { ecu_instance: 7, ..none }, 0x0000_0007_0000_0000),
            (NameFields { function_instance: 31, ..none }, 0x0000_00F8_0000_0000),
            (NameFields { function: 255, ..none }, 0x0000_FF00_0000_0000),
            (NameFields { vehicle_system: 127, ..none }, 0x00FE_0000_0000_0000),
            (NameFields { vehicle_system_instance: 15, ..none }, 0x0F00_0000_0000_0000),
            (NameFields { industry_group: 7, ..none }, 0x7000_0000_0000_0000),
            (NameFields { arbitrary_address_capable: true, ..none }, 0x8000_0000_0000_0000),
        ];
        for (fields, raw) in cases {
            assert_eq!(Name::new(&fields).unwrap().raw(), raw, "{fields:?}");
        }
    }

    #[test]
    fn bytes_are_sent_lowest_first() {
        let name = Name::new(&NameFields { identity_number: 0x12345, function: 0xAB, ..Default::default() }).unwrap();
        assert_eq!(name.to_bytes(), [0x45, 0x23, 0x01, 0, 0, 0xAB, 0, 0]);
        assert_eq!(name.to_string(), "0000AB0000012345");
    }

    #[test]
    fn field_that_does_not_fit_is_an_error() {
        let none = NameFields::default();
        for (fields, text) in [
            (NameFields { identity_number: 1 << 21, ..none }, "identity_number = 2097152, must be 0 to 2097151"),
            (NameFields { manufacturer_code: 2048, ..none }, "manufacturer_code = 2048, must be 0 to 2047"),
            (NameFields { ecu_instance: 8, ..none }, "ecu_instance = 8, must be 0 to 7"),
            (NameFields { function_instance: 32, ..none }, "function_instance = 32, must be 0 to 31"),
            (NameFields { vehicle_system: 128, ..none }, "vehicle_system = 128, must be 0 to 127"),
            (NameFields { vehicle_system_instance: 16, ..none }, "vehicle_system_instance = 16, must be 0 to 15"),
            (NameFields { industry_group: 8, ..none }, "industry_group = 8, must be 0 to 7"),
        ] {
            assert_eq!(Name::new(&fields).unwrap_err().to_string(), text);
        }
    }

    proptest! {
        #[test]
        fn bytes_round_trip(bytes: [u8; 8]) {
            prop_assert_eq!(Name::from_bytes(bytes).to_bytes(), bytes);
        }
    }
}
