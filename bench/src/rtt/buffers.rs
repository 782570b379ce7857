//! The system's limit of socket buffers. It is one for all network namespaces, and can be changed
//! in the first one only.

use std::process::{Command, Stdio};

/// The limit, as seen in the network namespace of the process that started this one.
pub(super) struct BufferLimit {
    outside: String,
}

impl BufferLimit {
    /// Returns the limit of this machine.
    pub(super) fn of_this_machine() -> Self {
        Self { outside: crate::live::starter().unwrap_or_default() }
    }

    /// Sets the limit in bytes. The process that started this one restores it.
    ///
    /// # Errors
    ///
    /// The reason, if that is not permitted.
    pub(super) fn set(&self, bytes: u64) -> Result<(), String> {
        let script = format!("echo {bytes} > {}", crate::live::BUFFER_LIMIT);
        self.outside(&script).map(drop)
    }

    /// Returns the limit in bytes; 0 if it is unknown.
    pub(super) fn bytes(&self) -> u64 {
        let text = self.outside(&format!("cat {}", crate::live::BUFFER_LIMIT));
        text.ok().and_then(|text| text.trim().parse().ok()).unwrap_or(0)
    }

    fn outside(&self, script: &str) -> Result<String, String> {
        let mut nsenter = Command::new("nsenter");
        nsenter.args(["-n", "-t", &self.outside, "sh", "-c", script]).stdin(Stdio::null());
        let output = nsenter.output().map_err(|error| format!("cannot run `nsenter`: {error}"))?;
        if output.status.success() {
            return Ok(String::from_utf8_lossy(&output.stdout).into_owned());
        }
        let error = String::from_utf8_lossy(&output.stderr);
        Err(format!("the limit of socket buffers cannot be set: {}", error.trim()))
    }
}
