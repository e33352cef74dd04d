//! Processes whose stderr cannot be written: a full disk under a log, a pipe that nobody reads. What they say is lost, what
//! they do is not.

use tempfile::TempDir;
use tests::{Process, Signal};

#[test]
fn a_farm_that_cannot_write_its_logs_computes() {
    let address = ["--listen", "127.0.0.1:0"];
    let mut coordinator =
        Process::start_muted("farm-coordinator", address.iter().chain(&["--http", "127.0.0.1:0"]));
    let ready = coordinator.next_json();
    let grpc = ready["grpc"].as_str().expect("an address").to_owned();
    let arguments = ["--coordinator", &grpc, "--device", "cpu"];
    let mut worker = Process::start_muted("farm-worker", address.iter().chain(&arguments));
    assert_eq!(worker.next_json()["event"], "ready");

    let folder = TempDir::new().expect("a temporary folder");
    let [alignment, results] = ["a.txt", "results"].map(|name| folder.path().join(name));
    std::fs::write(&alignment, "ACDE-\nACCE-\nCDDEA\nCCDEA\n").expect("the folder can be written");
    let [alignment, shown] = [&alignment, &results].map(|path| path.display().to_string());
    let run = ["--coordinator", &grpc, "mi", &alignment, "-o", &shown, "--iterations", "3"];
    let (status, _) = Process::start_muted("farmctl", run).finish();
    assert_eq!(status.code(), Some(0), "the exit code is that of the work: {status}");
    assert!(results.join("run.json").is_file(), "the results are written");

    for daemon in [worker, coordinator] {
        daemon.signal(Signal::Term);
        let (status, _) = daemon.finish();
        assert_eq!(status.code(), Some(0), "{status}");
    }
}
