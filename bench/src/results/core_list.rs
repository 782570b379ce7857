//! Lists of cores, as `taskset -c` takes them.

use std::collections::BTreeSet;
use std::fmt;
use std::str::FromStr;

/// Number of cores that the system's calls have room for (`cpu_set_t`).
const MAX_CORES: usize = 1024;

/// Cores of a machine, such as `2-5` or `0,2`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct CoreList(BTreeSet<usize>);

impl CoreList {
    /// The numbers of the cores, in ascending order.
    pub fn cores(&self) -> impl Iterator<Item = usize> {
        self.0.iter().copied()
    }

    /// Returns the cores of `usable` that are not in this list; `None` if there are none.
    ///
    /// # Errors
    ///
    /// The reason, if this list has other cores than `usable`.
    pub fn others_of(&self, usable: &Self) -> Result<Option<Self>, String> {
        let absent: Self = self.0.difference(&usable.0).copied().collect();
        if !absent.0.is_empty() {
            return Err(format!(
                "this program may not use {absent}: list some of {usable}, or start it on more cores"
            ));
        }
        let others: Self = usable.0.difference(&self.0).copied().collect();
        Ok(Some(others).filter(|others| !others.0.is_empty()))
    }
}

impl FromIterator<usize> for CoreList {
    fn from_iter<T: IntoIterator<Item = usize>>(cores: T) -> Self {
        Self(cores.into_iter().collect())
    }
}

impl FromStr for CoreList {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let mut cores = BTreeSet::new();
        for part in text.split(',') {
            let (first, last) = part.split_once('-').unwrap_or((part, part));
            let number = |text: &str| text.parse::<usize>().ok().filter(|core| *core < MAX_CORES);
            match (number(first), number(last)) {
                (Some(first), Some(last)) if first <= last => cores.extend(first..=last),
                _ => {
                    return Err(format!(
                        "`{part}` is no core and no range of cores: write numbers below \
                         {MAX_CORES}, as in 2-5 or 0,2"
                    ));
                }
            }
        }
        Ok(Self(cores))
    }
}

impl fmt::Display for CoreList {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut ranges: Vec<[usize; 2]> = Vec::new();
        for core in self.cores() {
            match ranges.last_mut() {
                Some([_, last]) if *last + 1 == core => *last = core,
                _ => ranges.push([core; 2]),
            }
        }
        let texts = ranges.into_iter().map(|[first, last]| match first == last {
            true => first.to_string(),
            false => format!("{first}-{last}"),
        });
        f.write_str(&texts.collect::<Vec<_>>().join(","))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn list(text: &str) -> CoreList {
        text.parse().unwrap()
    }

    #[test]
    fn a_list_has_numbers_and_ranges() {
        assert_eq!(list("0,2").cores().collect::<Vec<_>>(), [0, 2]);
        assert_eq!(list("2-5").cores().collect::<Vec<_>>(), [2, 3, 4, 5]);
        assert_eq!(list("7,4-5,5-6,1").to_string(), "1,4-7");
        assert_eq!(list("1023").to_string(), "1023");
    }

    #[test]
    fn a_wrong_part_of_a_list_is_named() {
        for (text, part) in [
            ("", ""),
            ("1,,2", ""),
            ("a", "a"),
            ("0,5-2", "5-2"),
            ("-1", "-1"),
            ("0-6:2", "0-6:2"),
            ("1024", "1024"),
            ("0-18446744073709551615", "0-18446744073709551615"),
        ] {
            let refused = text.parse::<CoreList>().unwrap_err();
            assert!(refused.starts_with(&format!("`{part}` is no core")), "{refused}");
        }
    }

    #[test]
    fn the_others_are_the_usable_cores_that_are_left() {
        assert_eq!(list("2-5").others_of(&list("0-7")), Ok(Some(list("0,1,6,7"))));
        assert_eq!(list("0-1").others_of(&list("0-1")), Ok(None));
    }

    #[test]
    fn an_absent_core_is_named_with_those_that_are_there() {
        let refused = list("1-3").others_of(&list("0-1")).unwrap_err();
        assert!(refused.contains("may not use 2-3: list some of 0-1"), "{refused}");
    }
}
