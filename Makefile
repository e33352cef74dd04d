# Everyday commands. `make demo` renders a picture on this machine; `make test` passes every test.

# Without it Mesa complains on a terminal that has no desktop.
export XDG_RUNTIME_DIR ?= /tmp

.PHONY: demo test check build bench

# Installs what is missing, builds, and renders the Cornell box through an embedded farm.
demo:
	./deploy/setup.sh
	cargo build --release --locked
	test -e demo/cornell/scene.toml || ./target/release/farmctl scene cornell-box demo/cornell
	./target/release/farmctl render demo/cornell -o demo/cornell.png -o demo/cornell.exr --size 256x256 --spp 64
	@echo "look at demo/cornell.png and demo/cornell.exr"

build:
	cargo build --release --locked

# Everything: lints, unit, property, GPU (lavapipe), multi-process, containers (where a Docker daemon answers).
test:
	./deploy/setup.sh test
	cargo build --workspace --bins --examples --locked
	cargo nextest run --workspace --locked
	cargo test --workspace --doc --locked --quiet
	FARMCTL=target/debug/farmctl ./tests/compose.sh

# What a commit must pass besides the tests.
check:
	cargo fmt --check
	cargo clippy --workspace --all-targets --locked -- -D warnings
	RUSTDOCFLAGS="-D warnings" cargo doc --workspace --no-deps --locked --quiet
	@if command -v cargo-deny >/dev/null 2>&1; then cargo deny check; else echo "cargo-deny is not installed: tests/crate_table.rs checks the crate table"; fi

# All figures beside their bars; wants a quiet machine and five minutes. Goes on past a bench that misses one.
bench: build
	@missed=0; for bench in scheduler steal fairness scaling recovery; do ./target/release/farmctl bench $$bench || missed=1; done; exit $$missed
