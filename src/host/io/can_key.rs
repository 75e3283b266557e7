//! Reads the key of authenticated frames once at the start, from a systemd credential or a file. The key is never
//! shown.
//!
//! In: the location of the key. Out: the AES-128-CMAC of given bytes. A key must have 16 bytes or 32 hex digits, and
//! its bytes must not all be equal. A key file must not be readable by other users. A credential is protected by the
//! service manager. Errors never contain the key.

use std::ffi::OsString;
use std::fmt;
use std::io::Read;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use aes::Aes128;
use cmac::{Cmac, KeyInit, Mac as _};

use crate::bounded_file;
use crate::can::secoc::Mac;
use crate::config::KeySource;

/// Length of a key, bytes.
const KEY_BYTES: usize = 16;

/// A key for AES-128-CMAC.
#[derive(Clone)]
pub struct CanKey(Cmac<Aes128>);

impl fmt::Debug for CanKey {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("CanKey(hidden)")
    }
}

impl CanKey {
    /// Reads the key. `credentials` is the folder of the service manager's credentials (`$CREDENTIALS_DIRECTORY`).
    ///
    /// # Errors
    /// Returns the location of the key and the reason why it cannot be used.
    pub fn load(source: &KeySource, credentials: Option<OsString>) -> Result<Self, String> {
        match source {
            KeySource::Credential(name) => {
                let folder = credentials.map(PathBuf::from).ok_or_else(|| {
                    format!("key of [authentication]: credential {name} cannot be read: $CREDENTIALS_DIRECTORY is not set; start the daemon with LoadCredential={name}:PATH")
                })?;
                Self::read(&folder.join(name), None)
            }
            KeySource::File(path) => Self::read(path, Some(nix::unistd::geteuid().as_raw())),
        }
    }

    /// Reads a file. `user`: the daemon's user. This user or root must own the file, and no other user may read it.
    /// `None` = the service manager protects the file.
    pub fn read(path: &Path, user: Option<u32>) -> Result<Self, String> {
        let error = |why: String| format!("key of [authentication]: {}: {why}", path.display());
        let unreadable = |why: std::io::Error| {
            error(format!("cannot be read: {why}, must be a file of {KEY_BYTES} bytes or {} hex digits", 2 * KEY_BYTES))
        };
        let file = bounded_file::open(path).map_err(unreadable)?;
        if let Some(user) = user {
            let found = file.metadata().map_err(|why| error(why.to_string()))?;
            let (owner, mode) = (found.uid(), found.mode() & 0o7777);
            if owner != 0 && owner != user {
                return Err(error(format!(
                    "belongs to user {owner}, must belong to root or to the daemon's user {user}"
                )));
            }
            // The mask 0o077 selects the permissions of the group and of all other users.
            if mode & 0o077 != 0 {
                return Err(error(format!("mode {mode:04o}, must be 0600 or 0400: no other user may read it")));
            }
        }
        let mut content = Vec::new();
        // Reads one byte more than the longest key (hex digits and a line break), to detect longer files.
        file.take(2 * KEY_BYTES as u64 + 3).read_to_end(&mut content).map_err(|why| error(why.to_string()))?;
        Self::parse(&content).map_err(error)
    }

    /// Parses a key from raw bytes, or from hex digits with or without a line break.
    ///
    /// # Errors
    /// Fails if the content has neither form, or if all bytes are equal.
    pub fn parse(content: &[u8]) -> Result<Self, String> {
        let found = content.len();
        let digits = content.trim_ascii_end();
        if digits.len() == KEY_BYTES && digits.iter().all(u8::is_ascii_hexdigit) {
            return Err(format!(
                "{KEY_BYTES} hex digits are {} bytes, must be {KEY_BYTES} bytes or {} hex digits",
                KEY_BYTES / 2,
                2 * KEY_BYTES
            ));
        }
        let neither = || format!("{found} bytes, must be {KEY_BYTES} bytes or {} hex digits", 2 * KEY_BYTES);
        let key = <[u8; KEY_BYTES]>::try_from(content).ok().or_else(|| hex_key(digits)).ok_or_else(neither)?;
        if key.iter().all(|byte| *byte == key[0]) {
            return Err("all bytes of the key are equal, must be random".to_owned());
        }
        Cmac::new_from_slice(&key).map(Self).map_err(|_| neither())
    }

    /// AES-128-CMAC of `bytes`.
    pub fn mac(&self, bytes: &[u8]) -> Mac {
        let mut mac = self.0.clone();
        mac.update(bytes);
        mac.finalize().into_bytes().into()
    }
}

fn hex_key(digits: &[u8]) -> Option<[u8; KEY_BYTES]> {
    let mut key = [0; KEY_BYTES];
    let value = |digit: u8| char::from(digit).to_digit(16).and_then(|value| u8::try_from(value).ok());
    if digits.len() != 2 * KEY_BYTES {
        return None;
    }
    for (byte, pair) in key.iter_mut().zip(digits.chunks(2)) {
        *byte = value(pair[0])? << 4 | value(pair[1])?;
    }
    Some(key)
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::PermissionsExt;

    use super::*;

    /// Key and messages of RFC 4493, section 4, also used as examples in NIST SP 800-38B, D.1.
    const KEY: &[u8] = b"2b7e151628aed2a6abf7158809cf4f3c";
    const MESSAGE: &str = "6bc1bee22e409f96e93d7e117393172aae2d8a571e03ac9c9eb76fac45af8e5130c81c46a35ce411e5fbc1191a0a52eff69f2445df4f9b17ad2b417be66c3710";

    fn hex(text: &str) -> Vec<u8> {
        text.as_bytes()
            .chunks(2)
            .map(|pair| u8::from_str_radix(std::str::from_utf8(pair).unwrap(), 16).unwrap())
            .collect()
    }

    #[test]
    fn cmac_matches_vectors_of_rfc_4493() {
        let key = CanKey::parse(KEY).unwrap();
        let message = hex(MESSAGE);
        for (len, mac) in [
            (0, "bb1d6929e95937287fa37d129b756746"),
            (16, "070a16b46b4d4144f79bdd9dd04a287c"),
            (20, "7d85449ea6ea19c823a7bf78837dfade"),
            (40, "dfa66747de9ae63030ca32611497c827"),
            (64, "51f0bebf7e3b9d92fc49741779363cfe"),
        ] {
            assert_eq!(key.mac(&message[..len]).to_vec(), hex(mac), "{len} bytes");
        }
    }

    #[test]
    fn key_is_raw_or_hex_and_never_shown() {
        let raw = hex(std::str::from_utf8(KEY).unwrap());
        let wanted = CanKey::parse(KEY).unwrap().mac(b"x");
        for same in [raw.as_slice(), b"2B7E151628AED2A6ABF7158809CF4F3C\n", b"2b7e151628aed2a6abf7158809cf4f3c\r\n"] {
            assert_eq!(CanKey::parse(same).unwrap().mac(b"x"), wanted);
        }
        for bad in [&b""[..], b"2b7e", b"zb7e151628aed2a6abf7158809cf4f3c", &[7; 17], &[b'0'; 33]] {
            let error = CanKey::parse(bad).unwrap_err();
            assert_eq!(error, format!("{} bytes, must be 16 bytes or 32 hex digits", bad.len()));
        }
        for short in [&b"2b7e151628aed2a6"[..], b"2b7e151628aed2a6\n"] {
            assert_eq!(
                CanKey::parse(short).unwrap_err(),
                "16 hex digits are 8 bytes, must be 16 bytes or 32 hex digits"
            );
        }
        assert_eq!(CanKey::parse(&[b'0'; 32]).unwrap_err(), "all bytes of the key are equal, must be random");
        assert_eq!(format!("{:?}", CanKey::parse(KEY).unwrap()), "CanKey(hidden)");
    }

    #[test]
    fn unusable_key_error_states_location() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("can.key");
        let source = KeySource::File(path.clone());
        let error = |source: &KeySource, credentials: Option<&Path>| {
            CanKey::load(source, credentials.map(|folder| folder.as_os_str().to_owned())).unwrap_err()
        };
        assert!(error(&source, None).contains("can.key: cannot be read: No such file or directory"));
        std::fs::create_dir(&path).unwrap();
        assert!(error(&source, None).contains("can.key: cannot be read: Is a directory"));
        std::fs::remove_dir(&path).unwrap();
        std::fs::write(&path, KEY).unwrap();
        for (mode, is_good) in [(0o600, true), (0o400, true), (0o640, false), (0o604, false), (0o620, false)] {
            std::fs::set_permissions(&path, std::fs::Permissions::from_mode(mode)).unwrap();
            assert_eq!(CanKey::load(&source, None).is_ok(), is_good, "{mode:o}");
        }
        assert!(error(&source, None).ends_with("can.key: mode 0620, must be 0600 or 0400: no other user may read it"));
        std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o600)).unwrap();
        let owner = path.metadata().unwrap().uid();
        assert!(CanKey::read(&path, Some(owner)).is_ok());
        if std::os::unix::fs::chown(&path, Some(1234), None).is_ok() {
            assert!(error(&source, None).contains("can.key: belongs to user 1234, must belong to root"));
            assert!(CanKey::read(&path, Some(1234)).is_ok());
        }
        let pipe = folder.path().join("pipe");
        assert!(std::process::Command::new("mkfifo").args(["-m", "600"]).arg(&pipe).status().unwrap().success());
        assert!(error(&KeySource::File(pipe), None).contains("is not a regular file"));
        let credential = KeySource::Credential("can.key".to_owned());
        assert!(error(&credential, None).contains("$CREDENTIALS_DIRECTORY is not set"));
        assert!(
            CanKey::load(&credential, Some(folder.path().as_os_str().to_owned())).is_ok(),
            "the manager keeps it private"
        );
    }
}
