//! The process `gleaner-inference`, started as `gleaner` starts it, and what the system reports
//! about its memory.

use std::fs::File;
use std::io::{BufRead, BufReader};
use std::os::fd::{AsFd, OwnedFd};
use std::os::unix::net::UnixStream;
use std::process::{Child, Command, Stdio};

use gleaner_protocol::Handover;
use gleaner_protocol::inference::{
    AddClient, GrantedModel, InferenceControl, InferenceReport, ModelClient, ModelEngine,
    ModelFile, ModelState,
};
use gleaner_tests::program;
use sha2::{Digest, Sha256};

/// A model of a measurement.
pub(super) struct BenchModel {
    pub(super) name: &'static str,
    pub(super) layout: gleaner_pixels::vision::DetectorLayout,
    pub(super) path: std::path::PathBuf,
    pub(super) sha256: String,
    pub(super) frames: usize,
}

/// Returns the SHA-256 of bytes, in hexadecimal digits.
pub(super) fn digest(bytes: &[u8]) -> String {
    Sha256::digest(bytes).iter().map(|byte| format!("{byte:02x}")).collect()
}

/// A started process. Dropping it ends it.
pub(super) struct ModelProcess {
    child: Child,
    control: InferenceControl,
    _handover: UnixStream,
}

impl ModelProcess {
    pub(super) fn start(model: &BenchModel) -> Self {
        let (control, end) = InferenceControl::pair().expect("sockets");
        let (handover, stdin) = UnixStream::pair().expect("sockets");
        let connections = Handover { control: Some(end), ..Handover::default() };
        connections.send(&handover).expect("it fits the socket");
        let mut child = Command::new(program("gleaner-inference"))
            .env("ORT_DISABLE_TELEMETRY", "1")
            .stdin(OwnedFd::from(stdin))
            .stdout(Stdio::piped())
            .spawn()
            .expect("gleaner-inference starts");
        let reports = BufReader::new(child.stdout.take().expect("a pipe")).lines();
        // Read to the end: it would wait for a full pipe.
        std::thread::spawn(move || {
            for line in reports.map_while(Result::ok) {
                if let Ok(InferenceReport::Model(model)) = serde_json::from_str(&line)
                    && model.state == ModelState::Failed
                {
                    eprintln!("cannot load the model: {}", model.reason);
                }
            }
        });
        let process = Self { child, control, _handover: handover };
        let file = File::open(&model.path).expect("the model exists");
        let path = model.path.display().to_string();
        let sent = ModelFile { sha256: model.sha256.clone(), path, engine: ModelEngine::None };
        process.control.add_model(&sent, file.as_fd(), None).expect("gleaner-inference reads");
        process
    }

    /// Connects a lambda that may use the model by `provider`, with one thread.
    pub(super) fn connect(&self, model: &BenchModel, provider: &str) -> ModelClient {
        let (lambda_end, socket) = ModelClient::pair().expect("sockets");
        let granted = GrantedModel {
            name: model.name.to_owned(),
            sha256: model.sha256.clone(),
            providers: vec![provider.to_owned()],
            threads: Some(super::THREADS),
            refused: None,
        };
        let (name, models) = ("bench".to_owned(), vec![granted]);
        let client = AddClient { name, memory: 64 << 20, models, ..AddClient::default() };
        self.control.add_client(&client, socket.as_fd()).expect("gleaner-inference reads");
        ModelClient::new(lambda_end)
    }

    pub(super) fn id(&self) -> u32 {
        self.child.id()
    }
}

impl Drop for ModelProcess {
    fn drop(&mut self) {
        // It may have ended by itself.
        let _ = self.control.stop();
        let _ = self.child.wait();
    }
}
