# Short names for common commands: https://just.systems

cargo_options := "--workspace --locked"

# List the recipes
default:
    @just --list

# Build the programs into target/debug
build:
    cargo build {{ cargo_options }} --bins

# Run every test
test *options:
    tests/all {{ options }}

# Run format, lints and fast tests
quick *options:
    tests/all --quick {{ options }}

# Check all lints
lint:
    cargo clippy {{ cargo_options }} --all-targets -- -D warnings

# Format the code
fmt:
    cargo fmt --all

# Build the manual into target/book, and check its links
docs:
    docs/build

# Show an ageing cell and its alarms, without CAN
demo:
    cargo run --no-default-features --locked -- demo
