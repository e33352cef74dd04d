//! The checked-in code under `src/gen` is what the `.proto` files give. `FARM_BLESS=1` writes it anew.

use std::{fs, path::Path};

const PROTOS: [&str; 5] = [
    "gleaner/v1/admin.proto",
    "gleaner/v1/apps.proto",
    "gleaner/v1/model.proto",
    "gleaner/v1/nodes.proto",
    "gleaner/v1/trust.proto",
];
const GENERATED: &str = "gleaner.v1.rs";

#[test]
fn checked_in_code_is_what_the_proto_files_give() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let made = tempfile::tempdir().unwrap();
    let descriptors = protox::compile(PROTOS, [root.join("proto")]).unwrap();
    tonic_prost_build::configure()
        .emit_rerun_if_changed(false)
        .out_dir(made.path())
        .compile_fds(descriptors)
        .unwrap();
    let made = fs::read_to_string(made.path().join(GENERATED)).unwrap();
    let kept_at = root.join("src/gen").join(GENERATED);
    if std::env::var_os("FARM_BLESS").is_some_and(|value| value == "1") {
        fs::write(&kept_at, made).unwrap();
        return;
    }
    let kept = fs::read_to_string(&kept_at).unwrap();
    assert!(made == kept, "{} is stale: run this test with FARM_BLESS=1", kept_at.display());
    assert!(made != kept.replace("PlanRequest", "PlanRequests"), "the comparison sees a renamed message");
}
