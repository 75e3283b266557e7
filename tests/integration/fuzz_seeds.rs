//! Runs `fuzz/seeds` and mutated copies of it through the fuzz entry points (`fuzz/src/doors`), without a fuzzer.
//! `PACKWATCH_FUZZ_CHANGES` sets the number of copies per entry point.

use std::path::Path;

use self::doors::DOORS;

#[path = "../../fuzz/src/doors/mod.rs"]
#[expect(unreachable_pub, dead_code, reason = "the fuzz targets look up an entry point by name")]
mod doors;

/// Number of mutated copies per entry point; the entry point `store` gets a tenth.
const CHANGES: usize = 200;

/// A pseudo-random stream (xorshift64*).
struct Stream(u64);

impl Stream {
    fn below(&mut self, limit: usize) -> usize {
        self.0 ^= self.0 >> 12;
        self.0 ^= self.0 << 25;
        self.0 ^= self.0 >> 27;
        (self.0.wrapping_mul(0x2545_F491_4F6C_DD1D) >> 33) as usize % limit.max(1)
    }
}

/// A copy of the seed with some bytes changed, repeated or inserted, or with its end cut off.
fn changed(seed: &[u8], stream: &mut Stream) -> Vec<u8> {
    let mut bytes = seed.to_vec();
    for _ in 0..=stream.below(6) {
        let at = stream.below(bytes.len());
        match stream.below(5) {
            0 if !bytes.is_empty() => bytes[at] ^= 1 << stream.below(8),
            1 if !bytes.is_empty() => bytes[at] = [0, 1, 0x7F, 0x80, 0xFF, b'9', b'-', b'"', b'\n'][stream.below(9)],
            2 => bytes.truncate(at),
            3 => {
                let end = (at + stream.below(32)).min(bytes.len());
                let part = bytes[at.min(end)..end].to_vec();
                let to = stream.below(bytes.len());
                bytes.splice(to..to, part);
            }
            _ => bytes.insert(at.min(bytes.len()), stream.below(256) as u8),
        }
    }
    bytes
}

fn seeds(door: &str) -> Vec<Vec<u8>> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("fuzz/seeds").join(door);
    let files = std::fs::read_dir(&folder).unwrap_or_else(|error| panic!("{}: {error}", folder.display()));
    let mut paths: Vec<_> = files.map(|file| file.unwrap().path()).collect();
    paths.sort();
    assert!(!paths.is_empty(), "{}: no seed", folder.display());
    paths.iter().map(|path| std::fs::read(path).unwrap()).collect()
}

const SHOWN: usize = 3;

#[test]
fn seeds_and_mutations_break_no_invariant() {
    let wanted: usize = std::env::var("PACKWATCH_FUZZ_CHANGES").map_or(CHANGES, |count| count.parse().unwrap());
    let mut broken = Vec::new();
    for (name, door) in DOORS {
        let seeds = seeds(name);
        let mut stream = Stream(0x9E37_79B9_7F4A_7C15);
        let copies = if *name == "store" { wanted / 10 } else { wanted };
        let copied = (0..copies).map(|count| changed(&seeds[count % seeds.len()], &mut stream));
        let inputs: Vec<Vec<u8>> = seeds.iter().cloned().chain(copied).collect();
        let is_broken = |input: &&Vec<u8>| std::panic::catch_unwind(|| door(input)).is_err();
        let found: Vec<String> =
            inputs.iter().filter(is_broken).map(|input| input.escape_ascii().to_string()).collect();
        println!("{name}: {} inputs, {} broken", inputs.len(), found.len());
        broken.extend(found.into_iter().take(SHOWN).map(|input| format!("{name}: {input}")));
    }
    assert!(broken.is_empty(), "{}", broken.join("\n"));
}
