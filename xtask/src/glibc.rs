//! Versions of the C library that programs need, read from their ELF files by `readelf` of
//! binutils, which reads those of every architecture.

use std::collections::BTreeMap;
use std::fmt;
use std::path::Path;

use gleaner_base::{Exit, Failure};

use crate::checkout::Checkout;
use crate::steps;

/// A version of glibc: 2.35 is `GlibcVersion(2, 35)`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct GlibcVersion(u32, u32);

/// The version of Ubuntu 22.04, and with it of JetPack 6.
pub(crate) const OF_JETPACK: GlibcVersion = GlibcVersion(2, 35);

/// The symbols that a file needs, by their versions.
#[derive(Debug, Default, PartialEq, Eq)]
pub(crate) struct GlibcNeeds {
    symbols: BTreeMap<GlibcVersion, Vec<String>>,
    /// Needs of the file's format, as `GLIBC_ABI_DT_RELR`, which glibc 2.36 is the first to have.
    formats: Vec<String>,
}

impl GlibcNeeds {
    /// Reads them from an ELF file.
    pub(crate) fn of(checkout: &Checkout, file: &Path) -> Result<Self, Failure> {
        let mut readelf = checkout.command("readelf");
        // In English, whatever the user has set.
        readelf.env("LC_ALL", "C").args(["--wide", "--version-info", "--dyn-syms"]).arg(file);
        let help = "on Debian and Ubuntu, as root: apt-get install binutils";
        Ok(Self::parse(&steps::output(&mut readelf, help)?))
    }

    /// Parses the output of `readelf`. A symbol that a program needs is a line that ends in
    /// `UND NAME@GLIBC_2.34 (5)`, and a needed version or format one with `Name: GLIBC_2.34`.
    fn parse(text: &str) -> Self {
        let mut needs = Self::default();
        for line in text.lines() {
            let symbol = line.split_once(" UND ").and_then(|(_, it)| it.split_once("@GLIBC_"));
            let need = symbol.or_else(|| line.split_once("Name: GLIBC_"));
            let Some((_, version)) = need else { continue };
            let version = version.split_whitespace().next().unwrap_or_default();
            let Some(version) = GlibcVersion::parse(version) else {
                needs.formats.push(format!("the format of GLIBC_{version}"));
                continue;
            };
            let symbols = needs.symbols.entry(version).or_default();
            symbols.extend(symbol.map(|(name, _)| name.to_owned()));
        }
        needs
    }

    /// Returns the newest version; `None` if the file needs no glibc.
    pub(crate) fn newest(&self) -> Option<GlibcVersion> {
        self.symbols.keys().max().copied()
    }

    /// Returns a sentence for each need that a machine with glibc `limit` does not meet.
    fn beyond(&self, limit: GlibcVersion) -> impl Iterator<Item = String> {
        let newer = self.symbols.iter().filter(move |(version, _)| **version > limit);
        newer
            .map(|(version, symbols)| format!("{} of glibc {version}", symbols.join(", ")))
            .chain(self.formats.iter().cloned())
    }
}

/// Checks that each of `files` runs with glibc `limit`; returns the newest version that they need.
pub(crate) fn check(
    checkout: &Checkout,
    files: &[impl AsRef<Path>],
    limit: GlibcVersion,
) -> Result<Option<GlibcVersion>, Failure> {
    let (mut newest, mut causes) = (None, Vec::new());
    for file in files.iter().map(AsRef::as_ref) {
        let needs = GlibcNeeds::of(checkout, file)?;
        let name = file.file_name().unwrap_or_default().to_string_lossy();
        causes.extend(needs.beyond(limit).map(|need| format!("`{name}` needs {need}")));
        newest = newest.max(needs.newest());
    }
    if causes.is_empty() {
        return Ok(newest);
    }
    let message = format!("not all programs run on a machine with glibc {limit}");
    let mut failure = Failure::new(Exit::Differs, message);
    failure.causes = causes;
    Err(failure.with_help(format!(
        "build on a system with glibc {limit} or older, as Ubuntu 22.04; or avoid these symbols"
    )))
}

impl GlibcVersion {
    fn parse(text: &str) -> Option<Self> {
        let mut numbers = text.split('.').map(|number| number.parse().ok());
        // A third number, as in 2.2.5, is older than all that counts here.
        Some(Self(numbers.next()??, numbers.next()??))
    }
}

impl fmt::Display for GlibcVersion {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}.{}", self.0, self.1)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const OUTPUT: &str = "
Symbol table '.dynsym' contains 3 entries:
   Num:    Value          Size Type    Bind   Vis      Ndx Name
     1: 0000000000000000     0 FUNC    GLOBAL DEFAULT  UND strlen@GLIBC_2.2.5 (3)
     2: 0000000000000000     0 FUNC    GLOBAL DEFAULT  UND arc4random@GLIBC_2.36 (4)
     3: 0000000000000000     0 FUNC    WEAK   DEFAULT  UND pidfd_spawnp@GLIBC_2.39 (5)
     4: 0000000000001139    31 FUNC    GLOBAL DEFAULT   12 own@@GLIBC_2.99
     5: 0000000000000000     0 FUNC    GLOBAL DEFAULT  UND PyLong_FromLong
     6: 0000000000000000     0 FUNC    GLOBAL DEFAULT  UND _Unwind_Resume@GCC_3.0 (2)
  0x0010:   Name: GLIBC_2.36  Flags: none  Version: 4
  0x0020:   Name: GLIBC_ABI_DT_RELR  Flags: none  Version: 6
  0x0030:   Name: GLIBC_2.2.5  Flags: none  Version: 3
  0x0040:   Name: GCC_3.0  Flags: none  Version: 2
";

    #[test]
    fn needs_beyond_the_limit_are_named_with_their_symbols() {
        let needs = GlibcNeeds::parse(OUTPUT);
        assert_eq!(needs.newest(), Some(GlibcVersion(2, 39)));
        let expected = [
            "arc4random of glibc 2.36",
            "pidfd_spawnp of glibc 2.39",
            "the format of GLIBC_ABI_DT_RELR",
        ];
        assert_eq!(needs.beyond(OF_JETPACK).collect::<Vec<_>>(), expected);
        assert_eq!(GlibcNeeds::parse("no dynamic section").newest(), None);
    }

    #[test]
    fn an_elf_file_is_checked_against_a_limit() {
        let checkout = Checkout::find().unwrap();
        let files = [std::env::current_exe().unwrap()];
        let newest = check(&checkout, &files, GlibcVersion(2, 999)).unwrap();
        assert!(newest > Some(GlibcVersion(2, 2)), "{newest:?}");
        let failure = check(&checkout, &files, GlibcVersion(2, 1)).unwrap_err();
        assert_eq!(failure.exit, Exit::Differs);
        let text = failure.to_string();
        assert!(text.contains("`xtask-") && text.contains("memcpy"), "{text}");
        assert!(text.contains("build on a system with glibc 2.1 or older"), "{text}");
    }
}
