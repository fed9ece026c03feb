// build_rulebooks NY NX RULE < scans: the rulebooks of scan after scan by one builder, each array after its size.
//
// Int32 in and out. Of each scan its number of cells and the cells; out come, level by level, strided, first, same and
// places, and then the head's cells.
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <string>
#include <vector>

#include "rulebooks.hpp"

namespace {

void write(const std::vector<int32_t>& values) {
    const auto count = static_cast<int32_t>(values.size());
    std::fwrite(&count, sizeof count, 1, stdout);
    std::fwrite(values.data(), sizeof(int32_t), values.size(), stdout);
}

}  // namespace

int main(int, char** arguments) {
    NeckRulebookBuilder builder(std::atoi(arguments[1]), std::atoi(arguments[2]), std::string(arguments[3]) == "fine");
    for (int32_t count; std::fread(&count, sizeof count, 1, stdin) == 1;) {
        std::vector<int32_t> cells(count);
        if (std::fread(cells.data(), sizeof(int32_t), cells.size(), stdin) != cells.size()) return 1;
        const NeckRulebooks& rulebooks = builder.build({cells.begin(), cells.end()});
        for (const auto& level : rulebooks.levels)
            for (const auto* table : {&level.strided, &level.first, &level.same, &level.places}) write(*table);
        write(rulebooks.head_cells);
    }
}
